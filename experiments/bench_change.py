"""Change detection against the truth: scores of whole runs, curves of the change masks, seconds and memory.

    python -m experiments.bench_change scores --scenes move turnover --seeds 0 1 [--captures FOLDER …] --out DIR
    python -m experiments.bench_change curves --out DIR --plots docs/images [--xfeat xfeat.onnx]
    python -m experiments.bench_change time

`scores` runs `ltgs update`, on built-in captures as `ltgs demo` does, less the long fit, which changes no event. What
`curves` measures is said in experiments/bench_change_curves.py. Both go on where they were interrupted.
"""

import dataclasses
import json
import math
import statistics
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path

import numpy as np
import tyro

from experiments.baselines.system import Silent, stage_seconds
from experiments.bench_change_curves import DEMO, Point, curve_points, halving_noise
from experiments.bench_change_time import memory_growth, time_parts
from experiments.captures import CaptureConfig, open_capture
from experiments.engine import Run, mean_of, read_table, run_all, vary
from experiments.report import Column, table
from ltgs_jax.detect import DetectConfig
from ltgs_jax.io import read_labels, read_tracks
from ltgs_jax.metrics import assign_objects, mask_iou
from ltgs_jax.pipeline import PRESETS, Config, for_small_photographs, update
from ltgs_jax.pipeline.evaluate import changed_names, read_truth


@dataclass(frozen=True)
class ScoreConfig:
    """One run of `ltgs update`."""

    capture: CaptureConfig = DEMO
    """Its seed is that of the run too, as in `ltgs demo`."""
    preset: str = "fast"
    overrides: tuple[tuple[str, float | int | bool], ...] = (("fit.long.passes", 0),)
    """(dotted name, value) of options of `ltgs update` that differ from the preset."""

    @property
    def label(self) -> str:
        """For lines of progress."""
        return f"{self.capture.label} {self.preset}"


def run_scores(config: ScoreConfig, folder: Path, cache: Path) -> dict:
    """The row of one capture."""
    capture = open_capture(config.capture, cache)
    options: Config = PRESETS[config.preset]
    if config.capture.built_in:
        options = for_small_photographs(options)
    for path, value in config.overrides:
        options = vary(options, path, value)
    out = folder / "chronology"
    update(capture, out, config=options, seed=config.capture.seed, progress=Silent())
    said = {m["key"]: m["value"] for m in json.loads((out / "metrics.json").read_text()) if m["visit"] is None}
    return {**said, **object_scores(out, capture), **stage_seconds(out)}


def object_scores(out: Path, folder: Path) -> dict[str, float]:
    """Objects reported, and where there is a truth: mean IoU per changed object, and the share of identities right.

    IoU: of an object that ever changes and of what was found for it, over all used photographs of later visits; 0 where
    nothing was. Identities: of each such object at each visit that shows it, whether what is found in its place at that
    visit is what was found for it over all. Left out where no such object is to be seen.
    """
    tracks, truth = read_tracks(out / "tracks.json"), read_truth(folder)
    row: dict[str, float] = {"objects": len(tracks["objects"])}
    if truth is None:
        return row
    visits = tracks["visits"]
    names = set().union(*(changed_names(truth, t - 1, t) for t in range(1, len(visits))))
    changed = sorted(truth["ids"][name] for name in names)
    found, true = {}, {}
    for visit in visits[1:]:
        paths = sorted((out / "masks" / visit).glob("*.png"))
        found[visit] = [read_labels(path).astype(np.int64) for path in paths]
        labels = [read_labels(truth["masks"] / visit / path.name).astype(np.int64) for path in paths]
        true[visit] = [np.where(np.isin(ids, changed), ids, 0) for ids in labels]
    every_found, every_true = (list(chain.from_iterable(images.values())) for images in (found, true))
    partners = {b: a for a, b in assign_objects(every_found, every_true).items()}
    ious, right = [], []
    for i in changed:
        if any((ids == i).any() for ids in every_true):
            mine, its = (
                np.concatenate([np.ravel(ids == identity) for ids in images])
                for images, identity in ((every_found, partners.get(i)), (every_true, i))
            )
            ious.append(mask_iou(mine, its))
    for visit in found:
        here = {b: a for a, b in assign_objects(found[visit], true[visit]).items()}
        # What hardly shows cannot be known again: an object must be as large as the least change.
        seen = [i for i in changed if any((ids == i).mean() >= DetectConfig().min_area for ids in true[visit])]
        right += [i in here and here[i] == partners.get(i) for i in seen]
    for key, values in (("object_iou", ious), ("identities_right", right)):
        if values:
            row[key] = statistics.fmean(values)
    return row


COLUMNS = (
    Column("events F1", "event_f1"),
    Column("identities right", "identities_right"),
    Column("mask F1", "mask_f1"),
    Column("IoU per object", "object_iou"),
    Column("objects reported", "objects", 0),
    Column("s (wall)", "seconds", 0),
    Column("CPU s", "seconds_cpu", 0),
)


def score_table(runs: list[Run], rows: dict[str, dict]) -> str:
    """A line per run, and the means of each capture that has several; failures with their reason."""
    lines, groups = [], {}
    for run in runs:
        row, capture = rows.get(run.name, {"status": "missing"}), run.options.capture
        name = capture.scene if capture.built_in else Path(capture.scene).name
        lines.append([f"{name} {capture.seed}", *_cells([row])] if row["status"] == "done" else [])
        lines[-1] = lines[-1] or [f"{name} {capture.seed}: {row.get('reason', row['status'])}", *["–"] * len(COLUMNS)]
        groups.setdefault(name, []).append(row)
    lines += [[f"{name}, mean", *_cells(group)] for name, group in groups.items() if len(group) > 1]
    return table(["capture, seed", *(column.title for column in COLUMNS)], lines)


def _cells(rows: list[dict]) -> list[str]:
    values = [(mean_of(rows, column.key), column.digits) for column in COLUMNS]
    return [f"{value:.{digits}f}" if math.isfinite(value) else "–" for value, digits in values]


@dataclass(frozen=True)
class Scores:
    """Whole runs against the truth, a line per capture and seed."""

    out: Path
    """Folder of runs, captures and table.csv."""
    scenes: tuple[str, ...] = ("move", "turnover", "clutter", "nochange", "light")
    seeds: tuple[int, ...] = (0,)
    captures: tuple[Path, ...] = ()
    """Folders of captures besides the built-in ones; run once per seed."""
    capture: CaptureConfig = DEMO
    """Sizes of the built-in captures."""
    preset: str = "fast"
    """Of `ltgs update`; built-in captures have its steps and splats cut to their size."""
    workers: int = 0
    """Local processes; 0: this one."""
    minutes: float = math.inf
    """After so many no further run is started."""
    retry: bool = False
    """Try failed runs again."""


@dataclass(frozen=True)
class Curves:
    """F1 of the change masks against threshold, noise, light, number of views, and time."""

    out: Path
    """Folder of runs, the capture and table.csv."""
    plots: Path | None = None
    """Folder of change_curves.png."""
    base: Point = field(default_factory=Point)
    """Capture, initial scene, and what is not varied."""
    xfeat: Path | None = None
    """XFeat as an ONNX file, for its point."""
    only: tuple[str, ...] = ()
    """Names of curves; none means all."""
    minutes: float = math.inf
    """After so many no further run is started."""


@dataclass(frozen=True)
class Time:
    """Seconds and memory per photograph, on a scene of random splats."""

    width: int = 640
    height: int = 480
    splats: int = 20_000
    photographs: tuple[int, int] = (4, 40)
    """Numbers of photographs between which memory is compared."""


def scores(options: Scores) -> str:
    """Run what is missing; the table."""
    named = [*options.scenes, *map(str, options.captures)]
    captures = [dataclasses.replace(options.capture, scene=name, seed=seed) for name in named for seed in options.seeds]
    runs = [Run("experiments.bench_change:run_scores", ScoreConfig(c, options.preset)) for c in captures]
    limits = {"workers": options.workers, "retry": options.retry, "deadline": 60 * options.minutes}
    run_all(runs, options.out, **limits, say=lambda line: print(line, flush=True))
    return score_table(runs, read_table(options.out))


def curves(options: Curves) -> str:
    """Run what is missing; a table per curve, and the picture."""
    points = curve_points(options.base, str(options.xfeat or ""))
    chosen = {name: runs for name, runs in points.items() if not options.only or name in options.only}
    every = [run for runs in chosen.values() for _, run in runs]
    run_all(every, options.out, deadline=60 * options.minutes, say=lambda line: print(line, flush=True))
    rows = read_table(options.out)
    done = {
        name: [(v, rows[r.name]) for v, r in runs if rows.get(r.name, {}).get("status") == "done"]
        for name, runs in chosen.items()
    }
    keys = ("f1", "precision", "recall", "matching_precision", "seconds_image", "seconds_ratio")
    text = "" if options.xfeat else "XFeat left out: no --xfeat FILE\n"
    for name, found in done.items():
        body = [[str(value), *(f"{row[key]:.3f}" if key in row else "–" for key in keys)] for value, row in found]
        text += f"\n{name}\n\n" + table([name, *(key.replace("_", " ") for key in keys)], body)
    if len(done.get("noise", ())) > 1:
        text += f"\nmatching precision is halved at σ = {halving_noise(done['noise']):.2f}\n"
    if options.plots is not None and all(done.get(name) for name in points):
        from experiments.bench_change_plot import draw_curves

        draw_curves(done, options.plots / "change_curves.png")
    return text


def time(options: Time) -> str:
    """The two measurements."""
    growth = memory_growth(options.photographs, options.width, options.height, options.splats)
    parts = time_parts(options.width, options.height, options.splats)
    body = [[name, *(f"{row[key]:.3f}" for key in ("seconds", "seconds_cpu", "ratio"))] for name, row in parts.items()]
    text = table([f"{options.width}×{options.height}", "s (wall)", "CPU s", "CPU s / control"], body)
    few, many = options.photographs
    lines = [f"{name}: {value:.2f} MB per photograph between {few} and {many}\n" for name, value in growth.items()]
    return text + "\npeak memory\n" + "".join(lines)


def main(options: Scores | Curves | Time) -> None:
    """Do it, and print."""
    print({Scores: scores, Curves: curves, Time: time}[type(options)](options))


if __name__ == "__main__":
    main(tyro.cli(Scores | Curves | Time, description=__doc__))
