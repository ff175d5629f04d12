"""What the long fit costs: the same change in scenes of growing size, and growing changes in one scene.

    python -m experiments.bench_fit --out FILE.json [--plots FOLDER] [--splats 20000 300000] [--objects 1 8]

A room of splats, photographed from a ring at two visits; between them some boxes move on the floor. Beside the long
fit stands one step on a whole photograph with all splats, what a fit that is not local takes. CPU time of all threads;
steps: the median; setting up (outlines, windows, who shows where): all of it, compiled before by the same fit.
"""

import json
import time
from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from experiments.curves import control, cpu_seconds
from ltgs_jax.fit import LongConfig, View, VisitView, fit_chronology, photometric_loss
from ltgs_jax.geometry import SE3, Camera, quat_from_rotmat
from ltgs_jax.render import plan_render, render
from ltgs_jax.scene import Chronology, Splats, Template, compose

_WIDTH, _HEIGHT = 320, 240
_BOX = 0.25  # side of a box that moves, in scene units; the room is 4 × 4 × 2


@dataclass(frozen=True)
class Options:
    """What to measure."""

    out: Path
    plots: Path | None = None
    splats: tuple[int, ...] = (20_000, 60_000, 150_000, 300_000)
    """Sizes of the scene in which one box moves."""
    objects: tuple[int, ...] = (1, 2, 4, 8)
    """Boxes that move, in the smallest scene."""
    photographs: int = 12
    """Of the first visit; a quarter as many of the second."""
    passes: int = 4


def _splats(points: np.ndarray, size: float, rng: np.random.Generator) -> Splats:
    """Splats at points in random colours."""
    count = len(points)
    return Splats(
        means=jnp.asarray(points, jnp.float32),
        quats=jnp.tile(jnp.asarray([1.0, 0, 0, 0]), (count, 1)),
        log_scales=jnp.full((count, 3), np.log(size), jnp.float32),
        logit_opacities=jnp.full(count, 2.0),
        sh=jnp.asarray(rng.uniform(-1.5, 1.5, (count, 1, 3)), jnp.float32),
    )


def make_room(count: int, boxes: int, seed: int = 0) -> Chronology:
    """Floor and walls of `count` splats, whose total area does not depend on the count, and boxes that move by 0.3."""
    rng = np.random.default_rng(seed)
    u, v = rng.uniform(-2, 2, count), rng.uniform(-2, 2, count)
    side = rng.integers(0, 5, count)
    walls = np.stack([np.where(side % 2, 2, -2), v, (u + 2) / 2], axis=1)
    walls = np.where((side > 2)[:, None], walls[:, [1, 0, 2]], walls)
    points = np.where((side == 0)[:, None], np.stack([u, v, 0 * u], axis=1), walls)
    background = _splats(points, 2.5 / np.sqrt(count), rng)
    angles = np.arange(boxes) * 2 * np.pi / max(boxes, 3)
    places = np.stack([np.cos(angles), np.sin(angles), np.full(boxes, _BOX / 2)], axis=1) * [0.9, 0.9, 1]
    templates = tuple(
        Template(_splats(place + rng.uniform(-_BOX / 2, _BOX / 2, (400, 3)), 0.02, rng), k + 1, 0)
        for k, place in enumerate(places)
    )
    xyz = np.zeros((2, boxes, 3), np.float32)
    xyz[1, :, 2], xyz[1, :, :2] = 0, -0.3 * places[:, :2]
    quat = np.tile(np.asarray([1, 0, 0, 0], np.float32), (2, boxes, 1))
    poses = SE3(jnp.asarray(quat), jnp.asarray(xyz))
    return Chronology(
        background, templates, poses, jnp.ones((2, boxes), bool), jnp.zeros((0, 3, 2)), ("before", "after")
    )


def ring(count: int) -> list[Camera]:
    """Cameras around the middle of the room that look at it."""
    K = jnp.asarray([[260.0, 0, _WIDTH / 2], [0, 260.0, _HEIGHT / 2], [0, 0, 1]])
    cameras = []
    for angle in np.arange(count) * 2 * np.pi / count:
        center = np.asarray([1.6 * np.cos(angle), 1.6 * np.sin(angle), 1.2])
        ahead = np.asarray([0, 0, 0.1]) - center
        ahead /= np.linalg.norm(ahead)
        right = np.cross(ahead, [0, 0, 1.0])
        right /= np.linalg.norm(right)
        R = np.stack([right, np.cross(ahead, right), ahead])
        pose = SE3(quat_from_rotmat(jnp.asarray(R, jnp.float32)), jnp.asarray(-R @ center, jnp.float32))
        cameras.append(Camera(pose, K, _WIDTH, _HEIGHT))
    return cameras


def bench(count: int, boxes: int, options: Options) -> dict:
    """One row."""
    chronology = make_room(count, boxes)
    cameras = ring(options.photographs)
    views = []
    for visit, chosen in ((0, cameras), (1, cameras[::4])):
        scene = compose(chronology, visit)
        for camera in chosen:
            image = np.clip(np.asarray(render(scene, camera).image), 0, 1)
            views.append(
                VisitView(View(camera, np.rint(255 * image).astype(np.uint8), np.ones(image.shape[:2], bool)), visit)
            )
    scene, view = compose(chronology, 1), views[-1].view
    plan = plan_render(scene, view.camera)
    target = jnp.asarray(view.image, jnp.float32) / 255

    @jax.jit
    def whole(splats: Splats):
        def loss(splats):
            image = render(splats, view.camera, plan=plan).image
            return photometric_loss(image, target, jnp.asarray(view.mask), dssim=0.2)

        return jax.grad(loss)(splats)

    config, key = LongConfig(passes=options.passes), jax.random.key(0)
    fit_chronology(chronology, views, key=key, config=config)  # compiles
    marks: list[tuple[float, str]] = []
    start = time.process_time()
    _, losses = fit_chronology(
        chronology,
        views,
        key=key,
        config=config,
        progress=lambda i, n, text: marks.append((time.process_time(), text)),
    )
    end, unit = time.process_time(), control()
    row = {
        "splats": count,
        "boxes": boxes,
        "windows": marks[0][1],
        "steps": len(losses),
        "setup_cpu_s": marks[0][0] - start,
        "step_cpu_ms": 1e3 * (end - marks[0][0]) / len(losses),
        "whole_step_cpu_ms": 1e3 * cpu_seconds(whole, scene),
        "control_cpu_ms": 1e3 * unit,
    }
    print(json.dumps(row), flush=True)
    return row


def plot(rows: list[dict], options: Options) -> None:
    """Seconds against the size of the scene, and against the number of things that changed."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    options.plots.mkdir(parents=True, exist_ok=True)
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.6))
    grown = [row for row in rows if row["boxes"] == options.objects[0]]
    more = [row for row in rows if row["splats"] == options.splats[0]]
    for ax, chosen, x in ((axes[0], grown, "splats"), (axes[1], more, "boxes")):
        at = [row[x] for row in chosen]
        ax.plot(at, [row["whole_step_cpu_ms"] for row in chosen], "s--", label="whole photograph, a step [ms]")
        ax.plot(at, [row["step_cpu_ms"] for row in chosen], "o-", label="long fit, a step [ms]")
        ax.plot(at, [row["setup_cpu_s"] for row in chosen], "^-", label="long fit, setting up [s]")
        ax.plot(at, [row["setup_cpu_s"] + row["step_cpu_ms"] * row["steps"] / 1e3 for row in chosen], "v-",
                label=f"long fit of {options.passes} passes [s]")  # fmt: skip
        ax.set(xscale="log", yscale="log", xlabel="splats in the scene" if x == "splats" else "things that moved")
        ax.set_xticks(at, [f"{value // 1000} k" if value >= 1000 else str(value) for value in at])
        ax.minorticks_off()
    axes[0].set_ylabel("CPU time")
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="lower center", ncol=2, frameon=False)
    figure.tight_layout(rect=(0, 0.16, 1, 1))
    figure.savefig(options.plots / "fit_growth.png", dpi=110)


def main(options: Options) -> None:
    """Measure, write, draw."""
    rows = [bench(count, options.objects[0], options) for count in options.splats]
    rows += [bench(options.splats[0], boxes, options) for boxes in options.objects[1:]]
    options.out.write_text(json.dumps(rows, indent=1))
    if options.plots is not None:
        plot(rows, options)


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
