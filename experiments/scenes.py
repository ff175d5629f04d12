"""A capture as arrays, the initial scene that every method starts from, and the one scorer that all are measured by.

`load_problem` gives the photographs as `ltgs_jax.fit.View`s: those of the first visit, those of each later visit
that a method may use, and the held-out ones with the region that changed (by the truth, where the capture brings
one). A method turns a problem into an `Answer`; `score` turns the answer into the columns of its row. No method sees
a held-out photograph.
"""

import dataclasses
import hashlib
import json
import math
import shutil
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import jax
import jax.numpy as jnp
import numpy as np

from experiments.captures import CaptureConfig, open_capture
from experiments.engine import Clock, write_json
from ltgs_jax.detect import dilate
from ltgs_jax.fit import InitialConfig, View, fit_initial, splats_from_points
from ltgs_jax.geometry import Camera
from ltgs_jax.io import (
    Photograph,
    load_image,
    load_mask,
    read_capture,
    read_labels,
    read_ply,
    scaled_size,
    write_image,
    write_ply,
)
from ltgs_jax.localize import LocalizeConfig, localize
from ltgs_jax.metrics import flip, psnr, ssim
from ltgs_jax.pipeline.evaluate import changed_names, read_truth
from ltgs_jax.pipeline.looks import Eye
from ltgs_jax.scene import Splats

_MARGIN = 5  # pixels by which the changed region is dilated, as `ltgs eval` does
_FREE = -15.0  # logit of opacity under which a splat is an empty slot


@dataclass(frozen=True)
class SceneConfig:
    """What a method works on."""

    capture: CaptureConfig = field(default_factory=CaptureConfig)
    max_side: int = 320
    """Longest side in pixels at which photographs are fitted and scored."""
    initial: InitialConfig = field(default_factory=lambda: InitialConfig(steps=250, max_splats=6000, sh_degree=0))


@dataclass(frozen=True)
class HeldOut:
    """A photograph that no method sees: `changed` where the scene is not that of the first visit, None if unknown."""

    name: str
    view: View
    changed: np.ndarray | None


@dataclass(frozen=True)
class Problem:
    """One capture. `update[t]` are the photographs of visit t that may be used (none at 0), `test[t]` the held-out."""

    folder: Path
    visits: tuple[str, ...]
    train: list[View]
    update: list[list[View]]
    test: list[list[HeldOut]]
    points: np.ndarray
    colors: np.ndarray

    @property
    def later(self) -> range:
        """The visits after the first."""
        return range(1, len(self.visits))


@dataclass(frozen=True)
class Answer:
    """What a method gives: `render(visit, camera)` [h w 3] in 0…1, what it keeps in bytes, and what else it says."""

    render: Callable[[int, Camera], np.ndarray]
    bytes: int
    said: dict[str, float] = field(default_factory=dict)


def load_problem(config: SceneConfig, cache: Path) -> Problem:
    """Read the capture; photographs without a pose are placed by `localize`, those that cannot be are left out."""
    folder = open_capture(config.capture, cache)
    capture = read_capture(folder)
    found = localize(capture, config=LocalizeConfig())
    capture = found.apply(capture)
    truth = read_truth(folder)

    def view(p: Photograph) -> View:
        image = load_image(p, max_side=config.max_side)
        size = scaled_size(p.width, p.height, config.max_side)
        pixels = np.rint(255 * image).astype(np.uint8)
        return View(found.cameras[p.name].resized(*size), pixels, load_mask(p, max_side=config.max_side))

    def placed(t: int, role: str) -> list[Photograph]:
        return [p for p in capture.at(t, role) if p.name in found.cameras]

    visits = range(len(capture.visits))
    test = [
        [HeldOut(p.name, view(p), _changed_region(truth, p, found.cameras[p.name], config)) for p in placed(t, "test")]
        for t in visits
    ]
    return Problem(
        folder,
        capture.visits,
        [view(p) for p in placed(0, "train")],
        [[view(p) for p in placed(t, "update")] for t in visits],
        test,
        capture.points,
        capture.point_colors,
    )


def _changed_region(truth: dict | None, photograph: Photograph, camera: Camera, config: SceneConfig):
    """Where a thing is that moved or came, and where one stood at the first visit that moved or left."""
    if truth is None:
        return None
    first = {name: np.asarray(pose) for name, pose in truth["times"][0].items()}
    names = changed_names(truth, 0, photograph.visit)
    labels = read_labels(truth["masks"] / Path(photograph.name).with_suffix(".png"))
    region = np.isin(labels, [truth["ids"][name] for name in names]).astype(np.uint8)
    for name in names & first.keys():
        corners = np.stack(np.meshgrid([-0.5, 0.5], [-0.5, 0.5], [0.0, 1.0]), axis=-1).reshape(-1, 3)
        world = corners * np.asarray(truth["extents"][name]) @ first[name][:3, :3].T + first[name][:3, 3]
        xy, z = camera.project(jnp.asarray(world, jnp.float32))
        if (np.asarray(z) > 0).all():
            cv2.fillConvexPoly(region, cv2.convexHull(np.asarray(xy, np.float32)).astype(np.int32), 1)
    region = dilate(region.astype(bool), _MARGIN).astype(np.uint8)
    size = scaled_size(photograph.width, photograph.height, config.max_side)
    return cv2.resize(region, size, interpolation=cv2.INTER_NEAREST).astype(bool)


def initial_scene(config: SceneConfig, problem: Problem, cache: Path) -> tuple[Splats, Path, dict[str, float]]:
    """The splats of the first visit, their file, and the seconds that they took; fitted once for all methods.

    The first visit is the same whatever the number of later photographs and the noise on their poses.
    """
    capture = dataclasses.replace(config.capture, update=3, used=None, pose_noise=0.0)
    key = dataclasses.asdict(dataclasses.replace(config, capture=capture))
    folder = cache / "initial" / hashlib.sha256(json.dumps(key, sort_keys=True, default=str).encode()).hexdigest()[:12]
    if not (folder / "seconds.json").is_file():
        with Clock() as clock:
            start = splats_from_points(
                problem.points, problem.colors, capacity=config.initial.max_splats, sh_degree=config.initial.sh_degree
            )
            splats = fit_initial(start, problem.train, key=jax.random.key(0), config=config.initial).splats
        write_ply(folder / "initial.ply", splats)
        write_json(folder / "seconds.json", clock.row())
    return read_ply(folder / "initial.ply"), folder / "initial.ply", json.loads((folder / "seconds.json").read_text())


def bytes_of(*trees: object) -> int:
    """Bytes of all arrays; of splats, those that show."""

    def size(node: object) -> int:
        if isinstance(node, Splats):
            shown = np.asarray(node.logit_opacities) > _FREE
            return sum(np.asarray(leaf)[shown].nbytes for leaf in jax.tree.leaves(node))
        return np.asarray(node).nbytes if hasattr(node, "dtype") else 0

    return sum(size(node) for node in jax.tree.leaves(trees, is_leaf=lambda node: isinstance(node, Splats)))


def per_visit_answer(scenes: list[Splats], kept: int | None = None, said: dict[str, float] | None = None) -> Answer:
    """An answer from one set of splats per visit."""
    eye = Eye()
    kept = bytes_of(scenes) if kept is None else kept
    return Answer(lambda visit, camera: eye.image(scenes[visit], camera), kept, said or {})


def score(problem: Problem, answer: Answer, folder: Path) -> dict[str, float]:
    """The columns of a row: PSNR, SSIM, FLIP, full, changed and static, pooled over later visits and per visit.

    Leaves one render per visit in folder/renders. `@t` is of visit t; `@0` tells what is forgotten of the first visit.
    """
    pooled: dict[str, list[float]] = {}
    times: list[float] = []
    shutil.rmtree(folder / "renders", ignore_errors=True)
    for t in range(len(problem.visits)):
        for i, held in enumerate(problem.test[t]):
            start = time.perf_counter()
            image = answer.render(t, held.view.camera)
            times.append(time.perf_counter() - start)
            target = held.view.image.astype(np.float32) / 255
            if i == 0:
                write_image(folder / "renders" / Path(held.name).with_suffix(".png"), image)
            regions = {"full": held.view.mask}
            if held.changed is not None and t > 0:
                regions["changed"] = held.view.mask & held.changed
                regions["static"] = held.view.mask & ~held.changed
            for region, mask in regions.items():
                if not mask.any():
                    continue
                values = {
                    "psnr": float(psnr(image, target, mask)),
                    "ssim": float(ssim(image, target, mask)),
                    "flip": float(flip(image, target, mask)),
                }
                for key, value in values.items():
                    if not math.isfinite(value):
                        continue
                    pooled.setdefault(f"{key}_{region}@{t}", []).append(value)
                    if t > 0:
                        pooled.setdefault(f"{key}_{region}", []).append(value)
    row = {key: statistics.fmean(values) for key, values in pooled.items()}
    return {**row, **answer.said, "bytes": answer.bytes, "fps": 1 / statistics.median(times) if times else math.nan}
