"""The picture of `bench_change curves`."""

from pathlib import Path

import matplotlib
import numpy as np

from experiments.bench_change_curves import halving_noise
from ltgs_jax.detect import DetectConfig

matplotlib.use("Agg")
import matplotlib.pyplot as plt

Points = list[tuple[float | str, dict]]
NAMES = {"f1": "F1", "precision": "precision", "recall": "recall", "matching_precision": "matching precision"}
_PIXELS = 900
_DPI = 100


def draw_curves(curves: dict[str, Points], path: Path) -> None:
    """Shares of the changed pixels against threshold, noise, light, number of photographs and time; 900 px wide."""
    layout = [["threshold", "noise"], ["light", "light"], ["views", "front end"]]
    figure, axes = plt.subplot_mosaic(layout, figsize=(_PIXELS / _DPI, 10.5), layout="constrained")
    _lines(axes["threshold"], curves["threshold"], ("f1", "precision", "recall"))
    axes["threshold"].axvline(DetectConfig().sigmas, color="gray", linestyle=":")
    axes["threshold"].set(xlabel="threshold, robust standard deviations", title="Threshold\n(dotted: the default)")
    _lines(axes["noise"], curves["noise"], ("f1", "matching_precision"))
    half = halving_noise(curves["noise"])
    title = "Noise on the features"
    if np.isfinite(half):
        axes["noise"].axvline(half, color="gray", linestyle=":")
        title += f"\n(dotted: σ = {half:.2f}, half as many matches right)"
    axes["noise"].set(xlabel="noise on descriptors, σ in shares of their norm", title=title)
    _bars(axes["light"], {"taken out": curves["light"], "left in": curves["light, not taken out"]})
    axes["light"].set(xlabel="light of the photographs", title="Light")
    _lines(axes["views"], curves["views"], ("f1", "precision", "recall"))
    title = "Number of views\n(objects, at held-out cameras)"
    axes["views"].set(xlabel="photographs explained together", title=title)
    axes["views"].set_xticks([value for value, _ in curves["views"]])
    _times(axes["front end"], curves["front end"])
    plt.setp([axis.title for axis in axes.values()], fontsize=11)
    for name in ("light", "front end"):
        axes[name].set_ylabel("F1 of changed pixels")
    for name in ("threshold", "views"):
        axes[name].set_ylabel("share of changed pixels")
    axes["noise"].set_ylabel("share of pixels, of matches")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=_DPI)
    plt.close(figure)


def _lines(axis, points: Points, keys: tuple[str, ...]) -> None:
    """One line per column, F1 thick; the legend above the points' range."""
    values = [value for value, _ in points]
    for key in keys:
        heights = [row.get(key, np.nan) for _, row in points]
        width = 2.5 if key == "f1" else 1.2
        axis.plot(values, heights, "o-" if key == "f1" else "s--", markersize=4, linewidth=width, label=NAMES[key])
    axis.set_ylim(0, 1.22)
    axis.set_yticks(np.arange(0, 1.01, 0.2))
    axis.grid(alpha=0.3)
    axis.legend(loc="upper center", ncols=3, fontsize=9)


def _bars(axis, sets: dict[str, Points]) -> None:
    """A group of bars per light."""
    width = 0.8 / len(sets)
    for i, (name, points) in enumerate(sets.items()):
        heights = [row["f1"] for _, row in points]
        bars = axis.bar(np.arange(len(points)) + (i - (len(sets) - 1) / 2) * width, heights, width, label=name)
        axis.bar_label(bars, fmt="%.2f", fontsize=8)
    axis.set_xticks(range(len(points)), [name for name, _ in points])
    axis.set_ylim(0, 1.22)
    axis.set_yticks(np.arange(0, 1.01, 0.2))
    axis.legend(loc="upper center", ncols=2, fontsize=9)


def _times(axis, points: Points) -> None:
    """F1 against time, a point per front end; the legend below them."""
    seconds = [row["seconds_image"] for _, row in points]
    for (name, row), second in zip(points, seconds, strict=True):
        axis.plot(second, row["f1"], "o", markersize=8, alpha=0.8, label=name)
    axis.set(xlim=(0, 1.15 * max(seconds)), ylim=(0, 1.05), title="Front ends")
    axis.set_xlabel("CPU seconds per photograph")
    axis.grid(alpha=0.3)
    axis.legend(loc="lower center", ncols=1, fontsize=9)
