"""Poses in the long fit: Adam along with the appearance, against Levenberg–Marquardt in between; time against error.

    python -m experiments.bench_pose_steps CAPTURE CHRONOLOGY --out FILE.json [--plot FILE.png]

CHRONOLOGY is a folder that `ltgs update CAPTURE CHRONOLOGY --fit.long.passes 0` left. The fit runs in chunks of passes,
the same for all, each from a fresh state of Adam; `alternating` holds the poses still in a chunk and refines each by a
few steps of `refine_pose` on all photographs that show the object there before every chunk. Error: of the poses of what
the first visit showed, by the truth; and PSNR over what changed in the held-out photographs. CPU seconds of all
threads, less what XLA compiled.
"""

import dataclasses
import json
import zlib  # noqa: F401  (before pycolmap)
from dataclasses import dataclass
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import tyro

from experiments.captures import CaptureConfig
from experiments.engine import Clock
from experiments.scenes import Problem, SceneConfig, load_problem, per_visit_answer, score
from ltgs_jax.fit import LongConfig, VisitView, fit_chronology, template_diameter
from ltgs_jax.fit.chronology import placements_of
from ltgs_jax.geometry import SE3
from ltgs_jax.io import load_chronology
from ltgs_jax.metrics import rotation_deg, translation_rel
from ltgs_jax.pipeline.evaluate import middle_and_size, read_truth, true_motion
from ltgs_jax.pipeline.looks import Eye
from ltgs_jax.pipeline.state import composed
from ltgs_jax.register.photometric import PhotometricConfig, Views, refine_pose
from ltgs_jax.scene import Chronology, drop_hidden, pad_splats, shade_splats
from ltgs_jax.template import make_crop, middle_of

_SIDE = 96  # pixels along the edge of the windows around an object
_VIEWS = 6  # photographs that a pose is refined on at most
_SPLATS = 2048  # templates are padded to


@dataclass(frozen=True)
class Options:
    """What to measure."""

    capture: tyro.conf.Positional[Path]
    chronology: tyro.conf.Positional[Path]
    out: Path
    plot: Path | None = None
    max_side: int = 320
    chunks: int = 4
    passes: int = 4
    """Of the long fit, in each chunk."""
    steps: int = 6
    """Of Levenberg–Marquardt, for each pose before each chunk."""


def refine_poses(chronology: Chronology, problem: Problem, eye: Eye, steps: int) -> Chronology:
    """Every pose that is not a template's own frame after some steps on the photographs that show it there."""
    placements = placements_of(chronology)
    index, visible = np.asarray(placements.index), np.asarray(chronology.visible)
    quat, xyz = (np.array(leaf) for leaf in (chronology.world_from_template.quat, chronology.world_from_template.xyz))
    for p, k in enumerate(np.asarray(placements.template)):
        visits = [t for t in problem.later if index[t, k] == p and visible[t, k]]
        if placements.fixed[p] or not visits:
            continue
        splats = jax.tree.map(jnp.asarray, chronology.templates[k].splats)
        if chronology.shade is not None:
            constant, *slope = np.asarray(chronology.shade[visits[0], k])
            splats = shade_splats(splats, constant + splats.means @ jnp.asarray(slope))
        size, pose = template_diameter(splats), placements.poses[p]
        views = _views_of(chronology, problem, eye, k, visits, np.asarray(pose.apply(splats.means)))
        options = PhotometricConfig(coarse_steps=0, steps=steps, margin=_SIDE)
        found = refine_pose(pad_splats(splats, _SPLATS), pose[None], views, size=size, reach=0.1 * size, config=options)
        quat[visits, k], xyz[visits, k] = np.asarray(found.poses.quat[0]), np.asarray(found.poses.xyz[0])
    return eqx.tree_at(lambda c: c.world_from_template, chronology, SE3(jnp.asarray(quat), jnp.asarray(xyz)))


def _views_of(chronology: Chronology, problem: Problem, eye: Eye, k: int, visits, points) -> Views:
    """Windows of the photographs of some visits around points, with all but template k as the backdrop."""
    hidden = np.array(chronology.visible)
    hidden[:, k] = False
    without = eqx.tree_at(lambda c: c.visible, chronology, hidden)
    shots = [(t, view) for t in visits for view in problem.update[t]][:_VIEWS]
    scenes = {t: drop_hidden(composed(without, t)) for t in visits}
    looks = [eye.look(scenes[t], view.camera, np.zeros(scenes[t].count)) for t, view in shots]
    boxes, valid = [], [np.asarray(view.mask, bool) for _, view in shots]
    for _, view in shots:
        xy = np.asarray(view.camera.project(jnp.asarray(points, jnp.float32))[0])
        low, high = np.quantile(xy, [0.02, 0.98], axis=0)
        side = max(1.6 * (high - low).max(), 24.0)
        boxes.append((*((low + high - side) / 2), side))
    more = _VIEWS - len(shots)
    every = [*range(len(shots)), *[0] * more]
    crop = make_crop(
        [shots[i][1].camera for i in every], [shots[i][1].image.astype(np.float32) / 255 for i in every],
        [looks[i].image for i in every], [looks[i].depth for i in every],
        [valid[i] & (n < len(shots)) for n, i in enumerate(every)], [valid[i] for i in every],
        [boxes[i] for i in every], size=_SIDE,
    )  # fmt: skip
    return Views(crop.camera, crop.target, crop.backdrop, crop.depth, crop.valid)


def pose_errors(chronology: Chronology, truth: dict) -> tuple[float, float]:
    """Median turn in degrees and shift in sizes of what the first visit showed and was moved, by the truth."""
    turns, shifts = [], []
    for k, template in enumerate(chronology.templates):
        if template.source_visit > 0:
            continue
        shown = middle_of(np.asarray(template.splats.means, np.float64))
        places = {name: middle_and_size(truth, name, 0) for name in truth["times"][0]}
        name = min(places, key=lambda n: np.linalg.norm(places[n][0] - shown) / places[n][1])
        middle, size = places[name]
        for t in range(1, len(chronology.visits)):
            motion = true_motion(truth, name, 0, t)
            if motion is None or not bool(chronology.visible[t, k]):
                continue
            pose = chronology.world_from_template[t, k]
            turns.append(rotation_deg(pose, motion))
            shifts.append(translation_rel(pose, motion, center=middle, size=size))
    return float(np.median(turns)), float(np.median(shifts))


METHODS = {"Adam": (True, False), "alternating": (False, True), "both": (True, True), "poses held": (False, False)}


def run(method: str, chronology: Chronology, problem: Problem, truth: dict, options: Options) -> list[dict]:
    """A row before the first chunk and one after each."""
    fit_poses, alternate = METHODS[method]
    config = dataclasses.replace(LongConfig(), passes=options.passes, fit_poses=fit_poses)
    views = [VisitView(v, t) for t in (0, *problem.later) for v in (problem.update[t] if t else problem.train)]
    rows, spent, eye = [], 0.0, Eye()
    for chunk in range(options.chunks + 1):
        with Clock() as clock:
            if chunk:
                if alternate:
                    chronology = refine_poses(chronology, problem, eye, options.steps)
                chronology, _ = fit_chronology(chronology, views, key=jax.random.key(chunk), config=config)
        spent += clock.cpu - clock.compile
        scenes = [drop_hidden(composed(chronology, t)) for t in range(len(problem.visits))]
        scored = score(problem, per_visit_answer(scenes, 1), options.out.parent / "scored")
        turn, shift = pose_errors(chronology, truth)
        rows.append(
            {"method": method, "passes": chunk * options.passes, "cpu_seconds": round(spent, 1), "turn_deg": turn,
             "shift_sizes": shift, "psnr_changed": scored["psnr_changed"], "psnr_full": scored["psnr_full"]}
        )  # fmt: skip
        print({key: round(v, 4) if isinstance(v, float) else v for key, v in rows[-1].items()}, flush=True)
    return rows


def draw(rows: list[dict], path: Path) -> None:
    """Error of the poses, and PSNR of what changed, against time."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(9, 3.6))
    for ax, key, label in zip(
        axes, ("turn_deg", "psnr_changed"), ("median turn [degrees]", "changed [dB]"), strict=True
    ):
        for method in METHODS:
            chosen = [row for row in rows if row["method"] == method]
            ax.plot([row["cpu_seconds"] for row in chosen], [row[key] for row in chosen], "o-", label=method)
        ax.set_xlabel("CPU seconds of the long fit")
        ax.set_ylabel(label)
        ax.grid(alpha=0.3)
    axes[0].legend(fontsize=8)
    figure.tight_layout()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)


def main(options: Options) -> None:
    """All methods from the same chronology."""
    problem = load_problem(SceneConfig(CaptureConfig(scene=str(options.capture)), options.max_side), options.out.parent)
    truth = read_truth(options.capture)
    if truth is None:
        raise SystemExit(f"{options.capture}: has no truth, by which poses could be scored")
    start = load_chronology(options.chronology)
    rows = [row for method in METHODS for row in run(method, start, problem, truth, options)]
    options.out.write_text(json.dumps(rows, indent=1))
    if options.plot is not None:
        draw(rows, options.plot)


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
