"""Markdown and plots from table.csv alone. A `Sheet` says which runs make one section, by their hashes.

The page keeps what people wrote: only what stands between the two marks is written anew. Rows that are not there yet
are missing in the page, and counted at its end; failures are listed with their reason. The best value of a column is
bold, whosever it is.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from experiments.engine import Run, mean_of

BEGIN, END = "<!-- generated: begin -->", "<!-- generated: end -->"
_BOUNDS = ("3dgs-dense",)


@dataclass(frozen=True)
class Sheet:
    """One section: its name, how it is drawn (a key of `_DRAW`), its runs by row, and the rows that are a preset's
    choice, with the presets' names."""

    name: str
    kind: str
    runs: dict[str, list[Run]]
    chosen: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Column:
    """A column: heading, key in the table, digits, factor, and which way is better (+1 higher, −1 lower, 0 neither)."""

    title: str
    key: str
    digits: int = 2
    factor: float = 1.0
    better: int = 0


COLUMNS = (
    Column("PSNR changed", "psnr_changed", better=1),
    Column("PSNR full", "psnr_full", better=1),
    Column("PSNR static", "psnr_static", better=1),
    Column("SSIM changed", "ssim_changed", 3, better=1),
    Column("SSIM full", "ssim_full", 3, better=1),
    Column("FLIP changed", "flip_changed", 3, better=-1),
    Column("FLIP full", "flip_full", 3, better=-1),
    Column("PSNR first visit", "psnr_full@0", better=1),
    Column("events F1", "event_f1", better=1),
    Column("CPU s", "seconds_cpu", 0, better=-1),
    Column("compile s (wall)", "seconds_compile", 0),
    Column("kB", "bytes", 0, 1e-3),
    Column("frames/s", "fps", 0),
)


EVIDENCE = (
    *(Column(f"poses by {kind}", f"poses_by_{kind}", 1) for kind in ("search", "matches", "registration")),
    Column("turn, °", "rotation_deg", better=-1),
    Column("shift, sizes", "translation_rel", 4, better=-1),
    *(column for column in COLUMNS if column.title in ("PSNR changed", "PSNR full", "events F1", "CPU s")),
)


def table(header: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """A Markdown table."""
    head = list(header)
    lines = [head, ["---"] * len(head), *(list(row) for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n"


def _cells(named: dict[str, list[dict]], columns: tuple[Column, ...], rivals: Iterable[str]) -> list[list[str]]:
    """Printed means per row, the best of the rivals in bold."""
    values = {name: [column.factor * mean_of(rows, column.key) for column in columns] for name, rows in named.items()}
    rivals = [name for name in rivals if name in values]
    printed = {name: [name] for name in values}
    for i, column in enumerate(columns):
        finite = [values[name][i] for name in rivals if math.isfinite(values[name][i])]
        best = (max if column.better > 0 else min)(finite) if finite and column.better else math.nan
        for name in values:
            value = values[name][i]
            text = f"{value:.{column.digits}f}" if math.isfinite(value) else "–"
            printed[name].append(f"**{text}**" if name in rivals and value == best and len(finite) > 1 else text)
    return list(printed.values())


def _done(runs: Iterable[Run], rows: dict[str, dict]) -> list[dict]:
    return [rows[run.name] for run in runs if run.name in rows and rows[run.name]["status"] == "done"]


def _complete(sheet: Sheet, rows: dict[str, dict]) -> dict[str, list[dict]]:
    """The rows of each variant that all captures are there of."""
    named = {name: _done(runs, rows) for name, runs in sheet.runs.items()}
    return {name: found for name, found in named.items() if len(found) == len(sheet.runs[name])}


def _comparison(sheet: Sheet, rows: dict[str, dict], images: Path) -> str:
    """Means over the captures that every method has finished, then each capture, then each visit."""
    labels = list(dict.fromkeys(run.options.scene.capture.label for runs in sheet.runs.values() for run in runs))
    by = {
        name: {run.options.scene.capture.label: rows[run.name] for run in runs if _done([run], rows)}
        for name, runs in sheet.runs.items()
    }
    rivals = [name for name in by if name not in _BOUNDS and by[name]]
    common = [label for label in labels if rivals and all(label in by[name] for name in rivals)]
    text = f"Means over {', '.join(common) or 'no capture'} (those that every method with a row has finished).\n\n"
    named = {name: [by[name][label] for label in common if label in by[name]] for name in by}
    text += table(
        ["method", *(c.title for c in COLUMNS)], _cells({k: v for k, v in named.items() if v}, COLUMNS, rivals)
    )
    for key, title in (("psnr_changed", "PSNR of the changed region"), ("psnr_full", "PSNR, full")):
        text += f"\n{title}, capture by capture:\n\n"
        lines: dict[str, list[str]] = {}
        for label in labels:
            column = Column(label, key, better=1)
            cells = _cells({n: [by[n][label]] if label in by[n] else [] for n in by}, (column,), rivals)
            for name, cell in cells:
                lines.setdefault(name, []).append(cell)
        text += table(["method", *labels], [[name, *cells] for name, cells in lines.items()])
    visits = [Column(f"{r} {t}", f"psnr_{r}@{t}", better=1) for r in ("changed", "full") for t in (1, 2, 3)]
    text += "\nPSNR visit by visit, over the same captures as the first table:\n\n"
    text += table(
        ["method", *(c.title for c in visits)],
        _cells({k: v for k, v in named.items() if v}, tuple(visits), rivals),
    )
    points = [(n, mean_of(named[n], "seconds_cpu"), mean_of(named[n], "psnr_changed")) for n in named if named[n]]
    picture = scatter(
        points, images / "results_comparison.png", "CPU seconds, compilation included", "PSNR changed, dB"
    )
    return text + picture


def _variants(sheet: Sheet, rows: dict[str, dict], images: Path) -> str:
    """One row per variant that all captures are there of."""
    named = _complete(sheet, rows)
    labels = {run.options.scene.capture.scene for runs in sheet.runs.values() for run in runs}
    text = f"Means over {', '.join(sorted(labels))}.\n\n" + table(
        ["variant", *(c.title for c in COLUMNS)], _cells(named, COLUMNS, named)
    )
    points = [
        (name, sum(mean_of(found, key) for key in ("seconds_initial", "seconds_cpu")), mean_of(found, "psnr_changed"))
        for name, found in named.items()
    ]
    path = images / f"results_{sheet.name}.png"
    return text + scatter(points, path, "CPU seconds, the first visit's among them", "PSNR changed, dB", sheet.chosen)


def _evidence(sheet: Sheet, rows: dict[str, dict], images: Path) -> str:
    """One row per variant that all captures are there of: what proposed poses, and how right they are."""
    del images
    named = _complete(sheet, rows)
    return "\n\n" + table(["variant", *(c.title for c in EVIDENCE)], _cells(named, EVIDENCE, named))


def _curves(sheet: Sheet, rows: dict[str, dict], images: Path) -> str:
    """Per curve a table of its points and a plot of time against error."""
    curves: dict[str, list[tuple[str, dict]]] = {}
    for name, runs in sheet.runs.items():
        curve, _, point = name.partition(": ")
        curves.setdefault(curve, []).extend((point, row) for row in _done(runs, rows))
    text = ""
    for curve, points in curves.items():
        if not points:
            continue
        what = points[0][1]["error_of"]
        text += f"\n### {curve.capitalize()}\n\n" + table(
            ["setting", "CPU time / control", what],
            [[point, f"{row['seconds_ratio']:.3g}", f"{row['error']:.3g}"] for point, row in points],
        )
        triples = [(point, row["seconds_ratio"], row["error"]) for point, row in points]
        chosen = {name.removeprefix(f"{curve}: "): presets for name, presets in sheet.chosen.items()}
        path = images / f"results_curve_{curve.replace(' ', '_')}.png"
        text += scatter(triples, path, "CPU time / control", what, chosen)
    return text


def _stability(sheet: Sheet, rows: dict[str, dict], images: Path) -> str:
    """Per driver a table of error growth, and a panel of one plot."""
    drivers: dict[str, list[dict]] = {}
    for name, runs in sheet.runs.items():
        drivers.setdefault(name.partition(": ")[0], []).extend(_done(runs, rows))
    text, lines = "", {}
    for driver, found in drivers.items():
        if not found:
            continue
        keys = [key for key in dict.fromkeys(k for row in found for k in row) if key.startswith("of ")]
        text += f"\n### {driver.capitalize()}\n\n" + table(
            [found[0]["driver_unit"], *(key.removeprefix("of ") for key in keys)],
            [[f"{row['driver_value']:g}", *(_number(row.get(key)) for key in keys)] for row in found],
        )
        what = f"{driver} [{found[0]['driver_unit']}]", keys[0].removeprefix("of ")
        lines[what] = [(row["driver_value"], row[keys[0]]) for row in found if isinstance(row.get(keys[0]), float)]
    return text + _growth({k: v for k, v in lines.items() if len(v) > 1}, images / "results_stability.png")


def _number(value: object) -> str:
    return f"{value:.2g}" if isinstance(value, float) else str(value if value is not None else "–")


def _axes(path: Path, rows: int = 1, columns: int = 1, size: tuple[float, float] = (6.4, 4.2)):
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    path.parent.mkdir(parents=True, exist_ok=True)
    return plt.subplots(rows, columns, figsize=size)


_LABEL = 0.045  # height of a name on a plot, in heights of the plot


def scatter(
    points: list[tuple[str, float, float]], path: Path, x: str, y: str, chosen: dict[str, str] | None = None
) -> str:
    """A labelled scatter plot against time, at least a hundredth of the longest, with a ring around what presets
    chose; the Markdown that shows it, or nothing without a point."""
    chosen = chosen or {}
    points = [p for p in points if math.isfinite(p[1]) and math.isfinite(p[2]) and p[1] > 0]
    if not points:
        return ""
    least = 0.01 * max(p[1] for p in points)
    points = [(name, max(a, least), b) for name, a, b in points]
    figure, axes = _axes(path)
    axes.plot([p[1] for p in points], [p[2] for p in points], "o", color="tab:brown")
    rings = [p[1:] for p in points if p[0] in chosen]
    axes.plot([a for a, _ in rings], [b for _, b in rings], "o", ms=13, mfc="none", mec="tab:brown")
    axes.set(xlabel=x, ylabel=y)
    times = [p[1] for p in points]
    if max(times) / min(times) > 5:
        axes.set_xscale("log")
    errors = [p[2] for p in points]
    if min(errors) > 0 and max(errors) / min(errors) > 30:
        axes.set_yscale("log")
    elif min(errors) > 0 and max(errors) / min(errors) < 1.1:  # as good as equal, and shown so
        axes.set_ylim(0.9 * min(errors), 1.1 * max(errors))
    # Names in a column at the side, none upon another, each tied to its point.
    axes.set_xlim(axes.get_xlim())
    axes.set_ylim(axes.get_ylim())
    places = axes.transAxes.inverted().transform(axes.transData.transform([p[1:] for p in points]))
    above = 1.0 + _LABEL
    for i in sorted(range(len(points)), key=lambda i: (-places[i][1].round(2), places[i][0])):
        above = level = min(places[i][1], above - _LABEL)
        name, *place = points[i]
        label = f"{name}, chosen ({chosen[name]})" if name in chosen else name
        axes.annotate(
            label, place, (1.02, level), textcoords="axes fraction", fontsize=7, va="center",
            arrowprops={"arrowstyle": "-", "color": "0.7", "linewidth": 0.5, "shrinkB": 3},
        )  # fmt: skip
    figure.savefig(path, dpi=80, bbox_inches="tight")
    return f"\n![{y} against {x}](images/{path.name})\n"


def _growth(lines: dict[tuple[str, str], list[tuple[float, float]]], path: Path) -> str:
    """A panel per driver: its value against the first error of its table."""
    if not lines:
        return ""
    columns = min(3, len(lines))
    count = -(-len(lines) // columns)
    figure, axes = _axes(path, count, columns, (3.4 * columns, 2.6 * count))
    panels = np.atleast_1d(axes).ravel()
    for ax, ((driver, error), pairs) in zip(panels, lines.items(), strict=False):
        positive = [(max(a, 1e-9), max(b, 1e-9)) for a, b in pairs]
        ax.loglog(*zip(*positive, strict=True), "o-", color="tab:brown", markersize=4)
        low, high = min(b for _, b in positive), max(b for _, b in positive)
        room = max(100 / (high / low), 4) ** 0.5  # two decades at least, so that noise does not look like growth
        ax.set_ylim(low / room, high * room)
        ax.minorticks_off()
        ax.set_xlabel(driver, fontsize=8)
        ax.set_ylabel(error, fontsize=8)
        ax.tick_params(labelsize=7)
    for ax in panels[len(lines) :]:
        ax.set_visible(False)
    figure.tight_layout()
    figure.savefig(path, dpi=80)
    return f"\n![Error growth over each driver](images/{path.name})\n"


_DRAW = {
    "comparison": _comparison,
    "variants": _variants,
    "evidence": _evidence,
    "curves": _curves,
    "stability": _stability,
}


def write_results(
    sheets: list[Sheet], rows: dict[str, dict], out: Path, *, page: Path | None = None, images: Path | None = None
) -> Path:
    """Draw every sheet that has a row; put the text between the marks of `page`, or into OUT/results.md."""
    images = images or out / "images"
    parts = []
    for sheet in sheets:
        runs = {run.name: run for group in sheet.runs.values() for run in group}
        there = [name for name in runs if name in rows]
        failed = [(runs[name], rows[name]) for name in there if rows[name]["status"] != "done"]
        parts.append(f"\n## {sheet.name.capitalize()}\n\n{len(there)} of {len(runs)} runs are there.")
        parts[-1] += " " + _DRAW[sheet.kind](sheet, rows, images) if len(there) > len(failed) else "\n"
        if failed:
            parts[-1] += "\nFailed:\n\n" + "".join(
                f"- {run.task.split('.')[-1]} {getattr(run.options, 'label', '')}: {row['reason']}\n"
                for run, row in failed
            )
    text = "\n".join(parts)
    target = page or out / "results.md"
    before, after = "", ""
    if page is not None and page.is_file() and BEGIN in page.read_text():
        before, rest = page.read_text().split(BEGIN, 1)
        after = rest.split(END, 1)[1]
    target.write_text(f"{before}{BEGIN}\n{text}\n{END}{after}")
    return target
