"""The points of `bench_change curves`: changed pixels of one later visit against a ray-cast truth, one setting each.

Every point starts from one initial scene. The photographs of visit 1 are compared with it one by one, as
`pipeline.looks.compare` does, or, for the number of views, together, as `pipeline.visit.explain_visit` does: there
an object must be seen by several, and what counts is where it shows in photographs that were not used. True are the
pixels that show a thing that is not where it was, at either visit; shadows are no change, and outlines are exact.
"""

import dataclasses
import functools
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import numpy as np

from experiments.baselines.system import Silent
from experiments.captures import CaptureConfig
from experiments.curves import control, cpu_seconds
from experiments.engine import Run
from experiments.front_ends import Colours, Noisy
from experiments.scenes import SceneConfig, initial_scene, load_problem
from ltgs_jax.demo import object_ids
from ltgs_jax.detect import DetectConfig, change_map, fit_tone
from ltgs_jax.features import Classical, FrontEnd, Onnx, OnnxModel, match_indices
from ltgs_jax.fit import InitialConfig, View
from ltgs_jax.io import load_image, load_mask, read_capture
from ltgs_jax.metrics import mask_f1
from ltgs_jax.pipeline import PRESETS, for_small_photographs
from ltgs_jax.pipeline.evaluate import changed_names, read_truth
from ltgs_jax.pipeline.expected import expected_errors
from ltgs_jax.pipeline.looks import Eye, Observation
from ltgs_jax.pipeline.state import State, scene_at
from ltgs_jax.pipeline.visit import explain_visit
from ltgs_jax.scene import Splats

DEMO = CaptureConfig(width=240, height=180, dense=30, points=4000)
"""The captures of `ltgs demo`."""
_SMALL = for_small_photographs(PRESETS["fast"])
_GAMMA = 2.2  # of the built-in captures' tone curve
_GRID = 4  # pixels between the descriptors that are matched
_RIGHT = 6.0  # pixels by which a right match may be off: its neighbours on the grid

Light = Callable[[np.ndarray], np.ndarray]


def _gain(red: float, green: float, blue: float) -> Light:
    """Factors on linear light."""
    return lambda image: np.clip(image**_GAMMA * np.float32([red, green, blue]), 0, 1) ** (1 / _GAMMA)


def _contrast(amount: float) -> Light:
    """Towards (or away from) an S-shaped curve."""
    return lambda image: image + amount * (image * image * (3 - 2 * image) - image)


LIGHTS: dict[str, Light] = {
    "as taken": lambda image: image,
    "−1 stop": _gain(0.5, 0.5, 0.5),
    "+1 stop": _gain(2, 2, 2),
    "warm": _gain(1.14, 1, 0.86),
    "cool": _gain(0.86, 1, 1.14),
    "contrast +": _contrast(0.3),
    "contrast −": _contrast(-0.3),
}
"""As strong as the capture `light` is at its strongest."""

FRONT_ENDS: dict[str, Callable[[str], FrontEnd]] = {
    "classical": lambda _: Classical(),
    "classical, stride 1": lambda _: Classical(stride=1),
    "classical, stride 4": lambda _: Classical(stride=4),
    "colours": lambda _: Colours(),
    "XFeat": lambda path: Onnx(
        describe_model=OnnxModel(path, "dense", 640, 480, grey=True, outputs=("feats",)), stride=8
    ),
}


@dataclass(frozen=True)
class Point:
    """One setting; all else is as the pipeline has it."""

    capture: CaptureConfig = field(default_factory=lambda: dataclasses.replace(DEMO, update=6))
    initial: InitialConfig = _SMALL.fit.initial
    sigmas: float = DetectConfig().sigmas
    noise: float = 0.0
    """Of every descriptor, relative to its norm."""
    light: str = "as taken"
    tone: bool = True
    """Whether `fit_tone` takes the light out."""
    front_end: str = "classical"
    model: str = ""
    """File of a front end that needs one."""
    views: int = 0
    """Photographs that are explained together; 0: each for itself."""

    @property
    def label(self) -> str:
        """For lines of progress."""
        changed = [f.name for f in dataclasses.fields(self) if f.name not in ("capture", "initial", "model")]
        return " ".join(f"{name}={getattr(self, name)}" for name in changed)


@dataclass(frozen=True, eq=False)
class Stage:
    """What all points share: `used` and `held` photographs of visit 1, each with its truth [h w]."""

    visits: tuple[str, ...]
    splats: Splats
    train: list[View]
    used: list[tuple[Observation, np.ndarray]]
    held: list[tuple[Observation, np.ndarray]]


@functools.lru_cache(maxsize=1)
def set_stage(capture: CaptureConfig, initial: InitialConfig, cache: Path) -> Stage:
    """The capture and its initial scene, fitted by the first point that needs it."""
    config = SceneConfig(capture, max_side=max(capture.width, capture.height), initial=initial)
    problem = load_problem(config, cache)
    splats, _, _ = initial_scene(config, problem, cache)
    opened, truth = read_capture(problem.folder), read_truth(problem.folder)
    changed = [truth["ids"][name] for name in changed_names(truth, 0, 1)]
    shots = []
    for role in ("update", "test"):
        photographs = opened.at(1, role)
        cameras = [photograph.camera for photograph in photographs]
        before, now = (object_ids(capture.scene, capture.seed, t, cameras) for t in (0, 1))
        shots.append(
            [
                (Observation(p.name, p.camera, load_image(p), load_mask(p)), np.isin(a, changed) | np.isin(b, changed))
                for p, a, b in zip(photographs, before, now, strict=True)
            ]
        )
    return Stage(opened.visits, splats, problem.train, *shots)


@functools.lru_cache(maxsize=4)
def _expected(stage: Stage, front_end: FrontEnd, gamma: float) -> np.ndarray:
    return expected_errors(Eye(), stage.splats, stage.train, front_end, gamma=gamma)


def pixel_scores(found: list[np.ndarray], true: list[np.ndarray]) -> dict[str, float]:
    """F1, precision and recall of masks, pooled over photographs."""
    a, b = (np.concatenate([np.ravel(mask) for mask in masks]) for masks in (found, true))
    both = (a & b).sum()
    return {
        "f1": mask_f1(a, b),
        "precision": float(both / a.sum()) if a.any() else float("nan"),
        "recall": float(both / b.sum()) if b.any() else float("nan"),
    }


def run_point(point: Point, folder: Path, cache: Path) -> dict:
    """The row of one setting."""
    stage = set_stage(point.capture, point.initial, cache)
    return score_views(point, stage) if point.views else score_masks(point, stage)


def score_masks(point: Point, stage: Stage) -> dict:
    """Change masks photograph by photograph."""
    front_end = Noisy(sigma=point.noise) if point.noise > 0 else FRONT_ENDS[point.front_end](point.model)
    config = dataclasses.replace(DetectConfig(), sigmas=point.sigmas)
    errors, eye = _expected(stage, front_end, config.gamma), Eye()
    found, right, seconds = [], [], []
    for shot, true in stage.used:
        look = eye.look(stage.splats, shot.camera, errors)
        image = np.rint(255 * LIGHTS[point.light](shot.image)).astype(np.float32) / 255
        if point.tone:
            image = fit_tone(image, look.image, shot.valid)(image)
        arguments = look.image, image, look.expected, shot.valid, front_end
        seconds.append(cpu_seconds(lambda a=arguments: change_map(*a, config=config), repeats=3))
        found.append(change_map(*arguments, config=config).mask)
        right += right_matches(look.image, image, ~true, front_end)
    return {
        **pixel_scores(found, [true for _, true in stage.used]),
        "matching_precision": float(np.mean(right)),
        "seconds_image": float(np.mean(seconds)),
        "seconds_ratio": float(np.mean(seconds)) / control(),
    }


def right_matches(rendered: np.ndarray, image: np.ndarray, same: np.ndarray, front_end: FrontEnd) -> list[bool]:
    """Whether each reciprocal match of dense descriptors leads to its own place, where nothing changed (`same`)."""
    ends = []
    for picture in (rendered, image):
        dense = front_end.describe(picture)
        step = max(1, _GRID // dense.stride)
        features = dense.features[::step, ::step]
        rows, columns = np.mgrid[: features.shape[0], : features.shape[1]] * step * dense.stride
        xy = np.stack([columns, rows], axis=-1).reshape(-1, 2)
        ends.append((xy.astype(np.float32), features.reshape(len(xy), -1)))
    a, b, _ = match_indices(*ends, max_ratio=10.0, min_cosine=-1.0)
    from_xy, to_xy = ends[0][0][a], ends[1][0][b]
    counted = same[from_xy[:, 1].astype(int), from_xy[:, 0].astype(int)]
    return (np.linalg.norm(from_xy - to_xy, axis=1) < _RIGHT)[counted].tolist()


def score_views(point: Point, stage: Stage) -> dict:
    """Objects explained from some photographs of visit 1, and where they show in the held-out ones."""
    count = len(stage.used)
    # From the middle, or evenly from one side to the other: the photographs go round the table.
    chosen = [count // 2] if point.views == 1 else np.linspace(0, count - 1, point.views).round().astype(int)
    front_end, eye = Classical(), Eye()
    config = dataclasses.replace(_SMALL, detect=dataclasses.replace(DetectConfig(), sigmas=point.sigmas))
    state = State.of_initial(stage.splats, _expected(stage, front_end, config.detect.gamma), stage.visits)
    observations = []
    for shot, _ in (stage.used[i] for i in chosen):
        tone = fit_tone(shot.image, eye.image(stage.splats, shot.camera), shot.valid)
        observations.append(dataclasses.replace(shot, image=tone(shot.image)))
    rng = np.random.default_rng([0, 1])
    options = {"earlier": lambda t: [], "eye": eye, "config": config, "rng": rng, "progress": Silent()}
    explained = explain_visit(state, 1, observations, front_end, **options)
    state, changed = explained.state, [account.template for account in explained.accounts]
    held = [shot for shot, _ in stage.held]
    covers = [eye.cover(scene_at(state, t), changed, held) for t in (0, 1)]
    found = [before | now for before, now in zip(*covers, strict=True)]
    return {**pixel_scores(found, [true for _, true in stage.held]), "objects": len(changed)}


def curve_points(base: Point, model: str) -> dict[str, list[tuple[float | str, Run]]]:
    """Per curve its points: what is varied, and the run. `model`: XFeat's file; its point is left out without one."""

    def runs(name: str, values: Iterable, **others) -> list[tuple[float | str, Run]]:
        task = "experiments.bench_change_curves:run_point"
        return [(value, Run(task, dataclasses.replace(base, **others, **{name: value}))) for value in values]

    return {
        "threshold": runs("sigmas", (1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0, 14.0, 20.0)),
        "noise": runs("noise", (0.0, 0.1, 0.2, 0.35, 0.5, 0.7, 1.0, 1.4, 2.0)),
        "light": runs("light", LIGHTS),
        "light, not taken out": runs("light", LIGHTS, tone=False),
        "views": runs("views", (1, 2, 3, 4, 6)),
        "front end": runs("front_end", [name for name in FRONT_ENDS if name != "XFeat"])
        + (runs("front_end", ["XFeat"], model=model) if model else []),
    }


def halving_noise(rows: list[tuple[float, dict]]) -> float:
    """The noise at which the precision of matches is half of that without noise, between points; NaN beyond them."""
    half = rows[0][1]["matching_precision"] / 2
    for (a, row), (b, after) in pairwise(rows):
        p, q = row["matching_precision"], after["matching_precision"]
        if p > half >= q:
            return a + (b - a) * (p - half) / (p - q)
    return float("nan")
