"""The baselines and the scorer on a capture of a few small photographs; the sheets and the page drawn from a table."""

import dataclasses
import json
import math
import shutil

import jax.numpy as jnp
import numpy as np
import pytest

from experiments import report, tables
from experiments.baselines.method import MethodConfig
from experiments.baselines.system import confidence_of
from experiments.captures import CaptureConfig, open_capture
from experiments.engine import MACHINE, Run, read_table, run_all
from experiments.scenes import Answer, SceneConfig, bytes_of, load_problem, score
from ltgs_jax.demo.story import SCENES
from ltgs_jax.fit import InitialConfig
from ltgs_jax.io import read_capture
from ltgs_jax.scene import Splats

SMALL = SceneConfig(
    CaptureConfig("move", width=48, height=36, dense=4, update=2, test=1, points=200),
    48,
    InitialConfig(steps=3, max_splats=256, sh_degree=0, coarse_fraction=0.0),
)


@pytest.fixture(scope="module")
def problem(tmp_path_factory):
    return load_problem(SMALL, tmp_path_factory.mktemp("problem"))


def test_a_problem_keeps_what_no_method_may_see_apart(problem):
    assert [len(views) for views in problem.update] == [0, 2, 2, 2]
    assert [len(held) for held in problem.test] == [1, 1, 1, 1]
    used = [view.image.tobytes() for views in (problem.train, *problem.update) for view in views]
    assert not {held.view.image.tobytes() for t in range(4) for held in problem.test[t]} & set(used)
    shares = [held.changed.mean() for t in problem.later for held in problem.test[t]]
    assert all(0 < share < 0.6 for share in shares)


def test_the_score_is_that_of_the_definition(problem, tmp_path):
    grey = 0.4

    def render(visit, camera):
        return np.full((camera.height, camera.width, 3), grey, np.float32)

    row = score(problem, Answer(render, 7), tmp_path)
    errors = []
    for t in problem.later:
        for held in problem.test[t]:
            pixels = (held.view.image / 255 - grey)[held.changed & held.view.mask]
            errors.append(-10 * math.log10(float(np.mean(pixels**2))))
    assert row["psnr_changed"] == pytest.approx(np.mean(errors), abs=1e-4)
    assert row["bytes"] == 7
    assert len(list((tmp_path / "renders").rglob("*.png"))) == 4


def test_empty_slots_weigh_nothing():
    splats = Splats(
        jnp.zeros((5, 3)),
        jnp.zeros((5, 4)),
        jnp.zeros((5, 3)),
        jnp.asarray([0.0, 1, -20, -jnp.inf, 2]),
        jnp.zeros((5, 1, 3)),
    )
    assert bytes_of(splats) == 3 * 4 * (3 + 4 + 3 + 1 + 3)


def test_where_nothing_happens_nothing_is_said_of_confidence():
    states = [{"event": "moved", "confidence": 0.4}, {"event": "still", "confidence": 1.0}]
    assert confidence_of({"objects": [{"states": states}]}) == {"confidence": 0.4}
    assert confidence_of({"objects": [{"states": states[1:]}]}) == {} == confidence_of({"objects": []})


@pytest.mark.slow
def test_noise_moves_only_the_poses_that_methods_use(tmp_path):
    plain = read_capture(open_capture(SMALL.capture, tmp_path))
    noisy = read_capture(open_capture(dataclasses.replace(SMALL.capture, pose_noise=1.0), tmp_path))
    for a, b in zip(plain.photographs, noisy.photographs, strict=True):
        assert a.path.read_bytes() == b.path.read_bytes()
        moved = float(jnp.linalg.norm(a.camera.center() - b.camera.center()))
        assert (moved > 1e-4) == (a.role == "update"), a.name


def test_a_deleted_run_comes_back_with_the_same_row(tmp_path):
    run = Run("experiments.baselines.static:run_all_photographs", MethodConfig(SMALL, steps=2))
    rows = []
    for _ in range(2):
        run_all([run], tmp_path, say=lambda line: None)
        rows.append(read_table(tmp_path)[run.name])
        assert rows[-1]["status"] == "done", rows[-1].get("reason")
        for part in ("runs", "initial"):  # the scene that all methods share as well
            shutil.rmtree(tmp_path / part)
    kept = [{k: v for k, v in row.items() if not k.startswith(MACHINE)} for row in rows]
    assert kept[0] == kept[1]
    assert {"psnr_full", "psnr_changed", "ssim_full", "flip_changed", "psnr_full@1", "bytes"} <= kept[0].keys()


@pytest.mark.slow
@pytest.mark.parametrize("method", [name for name in tables.METHODS if name != "3dgs-all"])
def test_every_method_has_a_row(method, tmp_path):
    run = Run(tables.METHODS[method], MethodConfig(SMALL, steps=2))
    run_all([run], tmp_path, say=lambda line: None)
    row = read_table(tmp_path)[run.name]
    assert row["status"] == "done", row.get("reason")
    assert 0 < row["psnr_full"] < 60
    assert row["bytes"] > 0


def _fake(sheet: report.Sheet) -> dict[str, dict]:
    """A row for every run but the last of each method."""
    rows = {}
    for i, (name, runs) in enumerate(sheet.runs.items()):
        for run in runs[: -1 if len(runs) > 1 else None]:
            row = {
                "status": "done",
                "psnr_changed": 20.0 + i,
                "psnr_full": 30.0 - i,
                "bytes": 1000.0,
                "seconds_cpu": 1.0 + i,
            }
            rows[run.name] = {**row, "label": name}
    return rows


def test_the_page_shows_whoever_wins_and_keeps_what_people_wrote(tmp_path):
    preset = dataclasses.replace(tables.PRESETS["tiny"], scenes=("move", "turnover"))
    sheet = report.Sheet("comparison", "comparison", tables.comparison_runs(preset, []))
    rows = _fake(sheet)
    broken = sheet.runs["local"][1].name
    rows[broken] = {"status": "failed", "reason": "ValueError: no reason"}
    page = tmp_path / "page.md"
    page.write_text(f"# Mine\n\n{report.BEGIN}\nold\n{report.END}\nlast words\n")
    report.write_results([sheet], rows, tmp_path, page=page, images=tmp_path / "images")
    text = page.read_text()
    assert text.startswith("# Mine")
    assert text.endswith("last words\n")
    assert "old" not in text
    methods = list(sheet.runs)
    best = len(methods) - 2  # the last is a bound and does not compete
    line = next(line for line in text.splitlines() if line.startswith(f"| {methods[best]} "))
    assert f"**{20 + best:.2f}**" in line
    assert f"**{30:.2f}**" in next(line for line in text.splitlines() if line.startswith("| untouched "))
    assert "**" not in next(line for line in text.splitlines() if line.startswith("| 3dgs-dense "))
    assert "ValueError: no reason" in text
    assert (tmp_path / "images" / "results_comparison.png").stat().st_size > 1000


def test_sheets_name_every_method_and_no_run_twice_for_different_options():
    options = tables.Options(preset="fast")
    every = tables.sheets(tables.PRESETS["fast"], options)
    assert {sheet.name for sheet in every} >= {
        "comparison",
        "ablation",
        "hyperparameters",
        "views",
        "curves",
        "stability",
        "presets",
    }
    comparison = every[0]
    assert {run.options.scene.capture.scene for runs in comparison.runs.values() for run in runs} == set(SCENES)
    configs = {}
    for sheet in every:
        for runs in sheet.runs.values():
            for run in runs:
                assert configs.setdefault(run.name, run.config()) == run.config()
                json.dumps(run.config())


@pytest.mark.parametrize("preset", tables.PRESETS)
def test_what_presets_chose_is_on_the_curves(preset):
    every = {sheet.name: sheet for sheet in tables.sheets(tables.PRESETS[preset], tables.Options(preset=preset))}
    curves = every["curves"]
    assert set(curves.chosen) <= set(curves.runs)
    assert {name.partition(": ")[0] for name in curves.chosen} == {name.partition(": ")[0] for name in curves.runs}
    for name in ("ablation", "hyperparameters", "presets"):
        assert set(every[name].chosen) & set(every[name].runs)


def test_a_plot_rings_what_was_chosen(tmp_path):
    points = [("a", 1.0, 2.0), ("b", 2.0, 1.0)]
    plain, ringed = tmp_path / "plain.png", tmp_path / "ringed.png"
    report.scatter(points, plain, "s", "dB")
    report.scatter(points, ringed, "s", "dB", {"b": "fast"})
    assert plain.read_bytes() != ringed.read_bytes()


def test_an_unknown_preset_or_sheet_is_named():
    with pytest.raises(SystemExit, match="--preset: expected one of tiny, small, fast, paper, got 'huge'"):
        tables.main(tables.Options(preset="huge"))
    with pytest.raises(SystemExit, match="--only: expected some of comparison"):
        tables.main(tables.Options(only=("nothing",)))
