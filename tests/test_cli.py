"""The `ltgs` command: options, exit statuses, one-line messages. The pipeline is a stand-in that records its calls."""

import inspect
import io
import os
import re
import signal
import subprocess
import sys
import types
from dataclasses import dataclass, field
from pathlib import Path
from typing import get_args, get_type_hints

import pytest
from rich.console import Console

from ltgs_jax.cli import main
from ltgs_jax.cli.arguments import Export, Update, UsageError, parse
from ltgs_jax.cli.commands import score_table, visit_number
from ltgs_jax.cli.main import INTERRUPTED, WRONG_INPUT, entry, keep_compiled_code
from ltgs_jax.cli.progress import BarReporter, LineReporter, make_reporter
from ltgs_jax.io import InputError, write_json


@dataclass(frozen=True)
class _Initial:
    steps: int = 100
    """Steps of the optimiser."""
    max_splats: int = 1000
    coarse_fraction: float = 0.3


@dataclass(frozen=True)
class _Long:
    steps: int = 300


@dataclass(frozen=True)
class _Fit:
    initial: _Initial = field(default_factory=_Initial)
    long: _Long = field(default_factory=_Long)


@dataclass(frozen=True)
class _Detect:
    tau_cos: float = 0.9


@dataclass(frozen=True)
class _Config:
    fit: _Fit = field(default_factory=_Fit)
    detect: _Detect = field(default_factory=_Detect)


_ROWS = [
    {"key": "psnr", "visit": None, "region": "full", "value": 23.4567, "unit": "dB", "direction": "higher"},
    {"key": "ssim", "visit": "[after]", "region": "changed", "value": None, "unit": "1", "direction": "higher"},
]


_RECORD = {
    "visits": ["before", "after"],
    "photographs": [
        {"name": "before/1.jpg", "status": "mapped", "reason": None},
        {"name": "before/2.jpg", "status": "thinned out", "reason": None},
        {"name": "after/1.jpg", "status": "rejected", "reason": "only 7 of its keypoints agree"},
    ],
    "points": 1234,
    "error_px": 0.71,
    "lenses": [{"params": [512.0, 1, 2, 0]}],
}


@pytest.fixture
def pipeline(monkeypatch):
    """A pipeline whose functions record what they were called with, and fail when told to."""
    from ltgs_jax.pipeline.config import for_small_photographs

    fake = types.ModuleType("ltgs_jax.pipeline")
    fake.Config = _Config
    fake.PRESETS = {"fast": _Config(), "tiny": _Config(fit=_Fit(_Initial(steps=7))), "paper": _Config()}
    fake.for_small_photographs = for_small_photographs
    fake.calls = []
    fake.error = None

    def update(capture, out, *, config, initial=None, seed=0, progress):
        fake.calls.append(("update", capture, out, config, initial, seed))
        if fake.error is not None:
            raise fake.error
        progress.stage("detect")
        progress.step(1, 2, "IMG_0001")
        progress.warn("IMG_0001/3.jpg: left out")
        for name, value in {"tracks": {"visits": ["a", "b"]}, "chronology": {}, "metrics": _ROWS}.items():
            write_json(out / f"{name}.json", value)

    def evaluate(folder, capture):
        fake.calls.append(("evaluate", folder, capture))
        return _ROWS

    fake.update, fake.evaluate = update, evaluate
    fake.render_visit = lambda *arguments: fake.calls.append(("render", *arguments))
    fake.export = lambda *arguments, **options: fake.calls.append(("export", *arguments, options))
    fake.IntakeConfig = types.SimpleNamespace

    def make_capture(folder, out, *, visits, config, progress):
        fake.calls.append(("capture", folder, out, visits, vars(config)))
        progress.stage("structure from motion")
        return _RECORD

    fake.make_capture = make_capture
    report = types.ModuleType("ltgs_jax.report")
    report.write_report = lambda folder: folder / "report.html"
    monkeypatch.setitem(sys.modules, "ltgs_jax.pipeline", fake)
    monkeypatch.setitem(sys.modules, "ltgs_jax.report", report)
    monkeypatch.setattr("ltgs_jax.pipeline", fake, raising=False)
    monkeypatch.setattr("ltgs_jax.report", report, raising=False)
    return fake


@pytest.fixture
def chronology(tmp_path) -> Path:
    write_json(tmp_path / "chronology.json", {})
    write_json(tmp_path / "tracks.json", {"visits": ["before", "after", "7"]})
    return tmp_path


def _one_line_error(capsys) -> str:
    err = capsys.readouterr().err
    lines = [line for line in err.splitlines() if not line.startswith("[")]
    assert len(lines) == 1 and lines[0].startswith("ltgs: "), err
    assert "Traceback" not in err and "│" not in err
    return lines[0]


def test_update_passes_everything_on(pipeline, tmp_path, capsys):
    words = "--preset tiny --seed 3 --initial i.ply --fit.initial.max-splats 55 --detect.tau_cos=0.8"
    assert main(["update", "in", "--out", str(tmp_path), *words.split()]) == 0
    (call,) = pipeline.calls
    assert call[:3] == ("update", Path("in"), tmp_path) and call[4:] == (Path("i.ply"), 3)
    assert call[3] == _Config(fit=_Fit(_Initial(steps=7, max_splats=55)), detect=_Detect(0.8))
    out, err = capsys.readouterr()
    assert "23.457" in out and "report.html" in out
    assert "detect" in err and "warning: IMG_0001/3.jpg: left out" in err


def test_an_option_of_a_room_goes_before_the_preset_wherever_it_stands(pipeline):
    record = parse(["update", "in", "--fit.initial.steps", "9", "--out", "o", "--preset=tiny"])
    assert isinstance(record, Update) and record.config.fit.initial.steps == 9
    assert parse(["update", "in", "--out", "o", "--preset=tiny"]).config.fit.initial.steps == 7


@pytest.mark.parametrize(
    "words, named",
    [
        ("update in --out o --fit.initial.stepz 5", "--fit.initial.stepz"),
        ("update in --out o --nonsense", "--nonsense"),
        ("update in", "--out"),
        ("update --out o", "PATH"),
        ("update in --out o --seed many", "--seed"),
        ("update in --out o --preset slow", "--preset"),
        ("update in --out o --fit.initial.steps 1.5", "--fit.initial.steps"),
        ("updat in", "updat"),
        ("render d --out o", "--visit"),
        ("export d --out o --format jpeg", "--format"),
        ("capture in --out o --first 2", "--first"),
        ("capture in --out o --max-side -5", "--max-side"),
        ("capture in", "--out"),
        ("view", "PATH"),
        ("demo --scene party", "--scene"),
    ],
)
def test_wrong_options_are_named_on_one_line(pipeline, capsys, words, named):
    assert main(words.split()) == 2
    error = _one_line_error(capsys)
    assert named in error and "helptext" not in error
    assert not pipeline.calls


@pytest.mark.parametrize("encoding", ["utf-8", "ascii"])
def test_messages_come_through_any_encoding(encoding):
    program = "import sys; from ltgs_jax.cli import main; sys.exit(main(['view', 'here', '--port', 'many']))"
    environment = {**os.environ, "PYTHONIOENCODING": encoding}
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, env=environment, timeout=60)
    assert done.returncode == 2
    said = done.stderr.decode().splitlines()
    assert len(said) == 1 and said[0].startswith("ltgs: Error parsing --port: invalid literal"), said


def test_a_narrow_terminal_changes_nothing(pipeline, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "40")
    assert main(["update", "in", "--out", "o", "--preset", "slow"]) == 2
    assert "--preset" in _one_line_error(capsys)


@pytest.mark.parametrize("words", [["--help"], ["update", "--help"], ["view", "-h"], ["--version"]])
def test_help_is_no_error(pipeline, capsys, words):
    assert main(words) == 0
    assert capsys.readouterr().out


def test_update_help_lists_the_options_of_the_rooms(pipeline, capsys):
    main(["update", "--help"])
    out = capsys.readouterr().out
    assert "--fit.initial.steps" in out and "--detect.tau-cos" in out and "Steps of the optimiser" in out


def test_no_command_shows_the_commands(capsys):
    assert main([]) == 2
    out = capsys.readouterr().out
    assert all(name in out for name in ("demo", "update", "eval", "render", "export", "view"))


@pytest.mark.parametrize(
    "error, status, says",
    [
        (InputError("images/a.jpg: cannot be\ndecoded"), 2, "images/a.jpg: cannot be decoded"),
        (KeyboardInterrupt(), 130, "interrupted"),
        (OSError(28, "No space left on device", "x.json"), 1, "No space left on device: 'x.json'"),
        (ImportError("No module named 'viser'"), 1, "viser"),
    ],
)
def test_faults_end_in_one_line_and_their_status(pipeline, tmp_path, capsys, error, status, says):
    pipeline.error = error
    assert main(["update", "in", "--out", str(tmp_path)]) == status
    assert says in _one_line_error(capsys)


def test_an_unforeseen_fault_shows_where_and_says_that_it_is_ours(pipeline, tmp_path, capsys):
    pipeline.error = ZeroDivisionError("no")
    assert main(["update", "in", "--out", str(tmp_path)]) == 1
    err = capsys.readouterr().err
    assert "Traceback" in err and err.splitlines()[-1].startswith("ltgs: ")


def test_a_polite_kill_is_an_interruption(pipeline, tmp_path, capsys):
    before = signal.getsignal(signal.SIGTERM)
    pipeline.update = lambda *_, **__: os.kill(os.getpid(), signal.SIGTERM)
    assert main(["update", "in", "--out", str(tmp_path)]) == 130
    assert signal.getsignal(signal.SIGTERM) is before


def test_visits_by_name_and_number(chronology):
    assert [visit_number(chronology, visit) for visit in ("before", "after", "1", "7", "2")] == [0, 1, 1, 2, 2]
    for wrong in ("3", "-1", "later", "²"):
        with pytest.raises(InputError, match="before, after"):
            visit_number(chronology, wrong)


def test_render_and_export(pipeline, chronology, capsys):
    folder = str(chronology)
    assert main(["render", folder, "--visit", "after", "--all-test", "--out", "o"]) == 0
    assert main(["render", folder, "--visit", "0", "--camera", "before/1.png", "--out", "o"]) == 0
    assert main(["export", folder, "--visit", "1", "--out", "v.ply"]) == 0
    assert main(["export", folder, "--format", "colmap", "--out", "c", "--capture", "moved"]) == 0
    assert pipeline.calls == [
        ("render", chronology, 1, None, True, Path("o")),
        ("render", chronology, 0, "before/1.png", False, Path("o")),
        ("export", chronology, "ply", Path("v.ply"), {"visit": 1, "capture": None}),
        ("export", chronology, "colmap", Path("c"), {"visit": None, "capture": Path("moved")}),
    ]
    capsys.readouterr()
    assert main(["render", folder, "--visit", "0", "--out", "o"]) == 2
    assert "--camera" in _one_line_error(capsys)


def test_capture_says_what_became_of_the_photographs(pipeline, capsys):
    assert main(["capture", "in", "--out", "o", "--visits", "b", "a", "--later", "5"]) == 0
    assert pipeline.calls == [
        ("capture", Path("in"), Path("o"), ("b", "a"), {"first": 100, "later": 5, "max_side": 1600})
    ]
    out = capsys.readouterr().out
    row = next(line for line in out.splitlines() if "after" in line)
    assert re.findall(r"\d+", row) == ["1", "0", "0", "0", "1"]
    assert "left out: after/1.jpg: only 7 of its keypoints agree" in out
    assert "1234 points" in out and "ltgs update o --out" in out


def test_the_short_names_of_limits_are_those_of_the_rooms(pipeline, tmp_path):
    words = ["update", "in", "--out", str(tmp_path), "--preset", "tiny", "--max-splats", "99"]
    assert main(words) == 0
    assert pipeline.calls[0][3] == _Config(fit=_Fit(_Initial(steps=7, max_splats=99)))


@pytest.mark.parametrize(
    "words", ["eval {0}", "render {0} --visit 0 --all-test --out o", "export {0} --out o", "view {0}"]
)
def test_a_folder_without_a_chronology_is_named(pipeline, tmp_path, capsys, words):
    assert main(words.format(tmp_path).split()) == 2
    assert str(tmp_path) in _one_line_error(capsys)


def test_eval_prints_the_scores(pipeline, chronology, capsys):
    assert main(["eval", str(chronology), "--capture", "elsewhere"]) == 0
    assert pipeline.calls == [("evaluate", chronology, Path("elsewhere"))]
    assert "23.457" in capsys.readouterr().out


def test_the_score_table_has_a_dash_where_there_is_no_score():
    console = Console(file=io.StringIO(), width=100)
    console.print(score_table(_ROWS))
    lines = console.file.getvalue().splitlines()
    assert any("psnr (dB)" in line and "ssim" in line for line in lines)
    assert any("all" in line and "full" in line and "23.457" in line and "–" in line for line in lines)
    assert any("[after]" in line for line in lines)


def test_plain_lines_do_not_flood(monkeypatch):
    clock = [0.0]
    monkeypatch.setattr("time.monotonic", lambda: clock[0])
    stream = io.StringIO()
    progress = LineReporter(stream)
    progress.stage("fit")
    for i in range(1, 1001):
        clock[0] += 0.1
        progress.step(i, 1000, "loss 0.1")
    progress.close()
    lines = stream.getvalue().splitlines()
    assert 5 <= len(lines) <= 12 and lines[0].endswith("fit") and "/1000 loss 0.1" in lines[-1]


def test_a_terminal_gets_a_bar():
    console = Console(file=io.StringIO(), force_terminal=True, width=80)
    progress = BarReporter(console)
    progress.stage("fit")
    progress.step(3, 10, "[loss]")
    progress.note("12 objects [3 new]")
    progress.stage("next")
    progress.close()
    shown = console.file.getvalue()
    assert "fit" in shown and "10/10" in shown and "12 objects [3 new]" in shown
    assert isinstance(make_reporter(io.StringIO()), LineReporter)


def test_compiled_code_is_kept_where_asked(monkeypatch, tmp_path):
    for name in ("JAX_COMPILATION_CACHE_DIR", "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"):
        monkeypatch.setenv(name, "")  # so that the test's own changes are undone
        monkeypatch.delenv(name)
    monkeypatch.setenv("LTGS_CACHE", "off")
    keep_compiled_code()
    assert "JAX_COMPILATION_CACHE_DIR" not in os.environ
    monkeypatch.setenv("LTGS_CACHE", str(tmp_path / "kept"))
    keep_compiled_code()
    assert os.environ["JAX_COMPILATION_CACHE_DIR"] == str(tmp_path / "kept")
    monkeypatch.setenv("LTGS_CACHE", str(tmp_path / "other"))
    keep_compiled_code()
    assert os.environ["JAX_COMPILATION_CACHE_DIR"] == str(tmp_path / "kept"), "jax's own variable goes first"
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR")
    monkeypatch.delenv("LTGS_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "user"))
    keep_compiled_code()
    assert os.environ["JAX_COMPILATION_CACHE_DIR"] == str(tmp_path / "user" / "ltgs_jax")


def test_the_installed_command_answers_without_importing_jax():
    program = (
        "import sys; from ltgs_jax.cli import main; status = main(['--help']); print('jax' in sys.modules, status)"
    )
    out = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=60)
    assert out.stdout.splitlines()[-1] == "False 0"


def test_an_unknown_command_is_a_usage_error():
    with pytest.raises(UsageError, match="demo, capture, update, eval"):
        parse(["explode"])


def test_the_demo_makes_its_capture_once(pipeline, tmp_path, monkeypatch, capsys):
    made = []

    def make_capture(folder, *, scene, seed):
        made.append((scene, seed))
        folder.mkdir(parents=True)

    demo = types.ModuleType("ltgs_jax.demo")
    demo.make_capture = make_capture
    monkeypatch.setitem(sys.modules, "ltgs_jax.demo", demo)
    for _ in range(2):
        assert main(["demo", "--out", str(tmp_path), "--scene", "move", "--seed", "4", "--preset", "tiny"]) == 0
    assert made == [("move", 4)]
    small = _Fit(_Initial(steps=7, coarse_fraction=0.0), _Long(300))  # no more than the small photographs need
    assert pipeline.calls[0][3].fit == small
    assert pipeline.calls[0] == pipeline.calls[1] and pipeline.calls[0][1:3] == (tmp_path / "capture", tmp_path)
    capsys.readouterr()
    assert main(["demo", "--out", str(tmp_path), "--scene", "light"]) == 2
    assert "another" in _one_line_error(capsys)


def test_the_real_pipeline_takes_what_the_commands_give():
    from ltgs_jax import pipeline

    for preset, config in pipeline.PRESETS.items():
        assert parse(["update", "in", "--out", "o", "--preset", preset]).config == config
    options = {"config": config, "initial": None, "seed": 0, "progress": LineReporter(io.StringIO())}
    inspect.signature(pipeline.update).bind(Path("in"), Path("out"), **options)
    inspect.signature(pipeline.evaluate).bind(Path("out"), None)
    inspect.signature(pipeline.render_visit).bind(Path("out"), 1, None, True, Path("folder"))
    inspect.signature(pipeline.export).bind(Path("out"), "ply", Path("file"), visit=1, capture=None)
    intake = pipeline.IntakeConfig(first=3, later=2, max_side=0)
    inspect.signature(pipeline.make_capture).bind(Path("in"), Path("out"), visits=(), config=intake, progress=None)
    assert get_args(get_type_hints(Export)["format"]) == pipeline.FORMATS


def test_the_documents_name_commands_and_options_that_exist(pipeline, capsys):
    root = Path(__file__).parents[1]
    lines = [
        line
        for path in (root / "README.md", *sorted((root / "docs").glob("*.md")))
        for line in path.read_text().splitlines()
        if line.startswith("ltgs ")
    ]
    assert len(lines) >= 10
    for line in lines:
        name = line.split()[1]
        assert main([name, "--help"]) == 0, line
        known = capsys.readouterr().out
        for option in re.findall(r"--[a-z][a-z-]*", line):
            assert option in known, line


def test_an_interrupted_process_does_not_wait_for_its_threads(monkeypatch):
    ended = []

    def end(status: int) -> None:
        ended.append(status)
        raise SystemExit(status)

    monkeypatch.setattr(os, "_exit", end)
    for status, ends in ((INTERRUPTED, [INTERRUPTED]), (WRONG_INPUT, [])):
        monkeypatch.setattr(sys.modules["ltgs_jax.cli.main"], "main", lambda status=status: status)
        ended.clear()
        with pytest.raises(SystemExit) as stopped:
            entry()
        assert (stopped.value.code, ended) == (status, ends)
