"""What each command does."""

import contextlib
import shutil
import signal
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import singledispatch
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table
from rich.text import Text

from ltgs_jax.io import InputError, read_json

from .arguments import Capture, Demo, Eval, Export, Render, Update, View
from .progress import Reporter, make_reporter


@singledispatch
def run(options: Any) -> None:
    """Do what a command's record of options says. Raises InputError, and whatever the rooms below raise."""
    raise TypeError(f"options: expected the record of a command, got {type(options).__name__}")


@run.register
def _demo(options: Demo) -> None:
    from ltgs_jax import pipeline

    capture = options.out / "capture"
    with _reporting() as progress:
        _make_demo_capture(capture, options, progress)
        config = pipeline.for_small_photographs(pipeline.PRESETS[options.preset])
        pipeline.update(capture, options.out, config=config, seed=options.seed, progress=progress)
    _finish(options.out, read_json(options.out / "metrics.json", list))


def _make_demo_capture(folder: Path, options: Demo, progress: Reporter) -> None:
    """Make the capture beside `folder` and rename it, so that a killed run leaves no half of one."""
    story = folder / "story.json"
    told = {"scene": options.scene, "seed": options.seed}
    if folder.exists():
        if not story.is_file() or read_json(story) != told:
            raise InputError(f"{folder}: holds another capture; choose another --out")
        return
    from ltgs_jax.demo import make_capture
    from ltgs_jax.io import write_json

    progress.stage("capture")
    beside = folder.with_name(".capture")
    shutil.rmtree(beside, ignore_errors=True)
    make_capture(beside, scene=options.scene, seed=options.seed)
    write_json(beside / story.name, told)
    beside.rename(folder)


@run.register
def _capture(options: Capture) -> None:
    from ltgs_jax import pipeline

    for name, least in (("first", 3), ("later", 1), ("max_side", 0)):
        if getattr(options, name) < least:
            raise InputError(f"--{name.replace('_', '-')} {getattr(options, name)}: expected at least {least}")
    config = pipeline.IntakeConfig(first=options.first, later=options.later, max_side=options.max_side)
    with _reporting() as progress:
        record = pipeline.make_capture(
            options.folder, options.out, visits=options.visits, config=config, progress=progress
        )
    _console().print(capture_table(record))
    for entry in record["photographs"]:
        if entry["status"] == "rejected":
            print(f"left out: {entry['name']}: {entry['reason'] or 'not part of the scene that was found'}")
    lens = record["lenses"][0]
    print(f"{record['points']} points, mean error {record['error_px']:.2f} px, focal length {lens['params'][0]:.0f} px")
    print(f"capture: {options.out}\nnext: ltgs update {options.out} --out {options.out}_chronology")


def capture_table(record: dict) -> Table:
    """What became of the photographs, one line per visit."""
    table = Table()
    table.add_column("visit")
    columns = ("found", "thinned out", "mapped", "localized", "rejected")
    for column in columns:
        table.add_column(column, justify="right")
    for visit in record["visits"]:
        mine = [p["status"] for p in record["photographs"] if p["name"].split("/")[0] == visit]
        table.add_row(Text(visit), str(len(mine)), *(str(mine.count(status)) for status in columns[1:]))
    return table


@run.register
def _update(options: Update) -> None:
    from ltgs_jax import pipeline

    with _reporting() as progress:
        pipeline.update(
            options.capture,
            options.out,
            config=_with_limits(options),
            initial=options.initial,
            seed=options.seed,
            progress=progress,
        )
    _finish(options.out, read_json(options.out / "metrics.json", list))


def _with_limits(options: Update) -> Any:
    """The options of the rooms, with the two that have a short name."""
    config = options.config
    if options.max_splats is not None:
        initial = replace(config.fit.initial, max_splats=options.max_splats)
        config = replace(config, fit=replace(config.fit, initial=initial))
    if options.max_side is not None:
        config = replace(config, io=replace(config.io, max_side=options.max_side))
    return config


@run.register
def _eval(options: Eval) -> None:
    from ltgs_jax import pipeline

    rows = pipeline.evaluate(_chronology(options.folder), options.capture)
    _finish(options.folder, rows)


@run.register
def _render(options: Render) -> None:
    from ltgs_jax import pipeline

    if (options.camera is None) != options.all_test:
        raise InputError("render: give one of --camera and --all-test")
    visit = visit_number(_chronology(options.folder), options.visit)
    pipeline.render_visit(options.folder, visit, options.camera, options.all_test, options.out)
    print(options.out)


@run.register
def _export(options: Export) -> None:
    from ltgs_jax import pipeline

    folder = _chronology(options.folder)
    visit = None if options.visit is None else visit_number(folder, options.visit)
    pipeline.export(folder, options.format, options.out, visit=visit, capture=options.capture)
    print(options.out)


@run.register
def _view(options: View) -> None:
    folder = _chronology(options.folder)
    from ltgs_jax.view import serve

    serve(folder, host=options.host, port=options.port)


def visit_number(folder: Path, visit: str) -> int:
    """The place of a visit that is given by name or by number. Raises InputError that lists the visits."""
    visits = read_json(folder / "tracks.json").get("visits", [])
    if visit in visits:
        return visits.index(visit)
    if visit.isdecimal() and int(visit) < len(visits):
        return int(visit)
    raise InputError(
        f"--visit {visit}: no such visit; there are {', '.join(map(str, visits))} (0 to {len(visits) - 1})"
    )


def score_table(rows: Sequence[dict]) -> Table:
    """The rows of metrics.json as a table: one line per visit and region, one column per score."""
    keys = list(dict.fromkeys(row["key"] for row in rows))
    table = Table()
    table.add_column("visit")
    table.add_column("region")
    for key in keys:
        unit = next(row["unit"] for row in rows if row["key"] == key)
        table.add_column(key if unit in ("", "1") else f"{key} ({unit})", justify="right")
    values = {(row["visit"], row["region"], row["key"]): row["value"] for row in rows}
    for visit, region in dict.fromkeys((row["visit"], row["region"]) for row in rows):
        cells = [values.get((visit, region, key)) for key in keys]
        shown = ["–" if value is None else f"{value:.3f}" for value in cells]
        table.add_row(Text("all" if visit is None else str(visit)), region, *shown)
    return table


def _finish(folder: Path, rows: Sequence[dict]) -> None:
    """Write the report, print the scores and where the report is."""
    from ltgs_jax.report import write_report

    report = write_report(folder)
    _console().print(score_table(rows))
    print(f"report: {report}")


def _console() -> Console:
    console = Console()
    return console if console.is_terminal else Console(width=120)  # a log file is no narrower than that


def _chronology(folder: Path) -> Path:
    if not (folder / "chronology.json").is_file():
        raise InputError(f"{folder}: holds no chronology (chronology.json is missing)")
    return folder


@contextlib.contextmanager
def _reporting() -> Iterator[Reporter]:
    """A reporter that is closed at the end; a polite kill then ends like Ctrl-C.

    To be entered after the pipeline is imported: the import of pycolmap takes the signal for itself.
    """

    def interrupt(*_) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    progress = make_reporter()
    try:
        yield progress
    finally:
        progress.close()
        signal.signal(signal.SIGTERM, before)
