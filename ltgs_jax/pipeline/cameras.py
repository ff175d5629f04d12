"""The cameras of a run: given, placed by features, then held against renders of the initial scene."""

import dataclasses

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ltgs_jax.geometry import SE3, Camera
from ltgs_jax.io import CameraModel, Capture, InputError, Photograph, scaled_size
from ltgs_jax.localize import Localization, PhotographStatus, align_later, localize
from ltgs_jax.scene import Splats

from .config import Config
from .looks import Eye
from .store import Store


@dataclasses.dataclass(frozen=True)
class Run:
    """What every stage needs; `on_renders` names the photographs whose pose was found on renders of the first scene."""

    capture: Capture
    found: Localization
    config: Config
    seed: int
    on_renders: frozenset[str] = frozenset()

    @property
    def cameras(self) -> dict[str, Camera]:
        """Of every photograph that has one, by name."""
        return self.found.cameras

    def poses(self, visit: int) -> list[str | Float[np.ndarray, "..."]]:
        """Names, poses and K of a visit's cameras, by which a stage tells others from them."""
        named = [
            (p.name, self.cameras[p.name])
            for p in self.capture.photographs
            if p.visit == visit and p.name in self.cameras
        ]
        return [
            part
            for name, camera in named
            for part in (name, np.asarray(camera.cam_from_world.as_matrix()), np.asarray(camera.K))
        ]

    def posed(self, visit: int, role: str) -> list[Photograph]:
        """Photographs of a visit and role whose camera is known."""
        return [p for p in self.capture.at(visit, role) if p.name in self.cameras]


def scaled_camera(camera: Camera, max_side: int | None) -> Camera:
    """The camera at the size that photographs are worked on."""
    return camera.resized(*scaled_size(camera.width, camera.height, max_side))


def locate_photographs(store: Store, key: str, capture: Capture, config: Config, seed: int, progress) -> Run:
    """Cameras of all photographs, those without a pose placed against the first visit by their features."""

    def compute():
        return _packed(localize(capture, config=config.localize, progress=_steps_of(progress)))

    found = _unpacked(*store.run("localize", key, compute))
    for photograph in found.photographs:
        if photograph.status == "rejected":
            progress.note(f"{photograph.name}: not placed by its features, {photograph.reason}")
    run = Run(found.apply(capture), found, config, seed)
    if not run.posed(0, "train"):
        raise InputError(f"{capture.folder}: no photograph of the first visit has a pose")
    return run


def hold_against_renders(store: Store, key: str, run: Run, initial: Splats, eye: Eye, progress) -> Run:
    """The run after the later photographs were held against renders of the initial scene: some that features could not
    place have a camera now, and given poses that were rough are mended."""

    def view(camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        look = eye.look(initial, camera, np.zeros(initial.count))
        return look.image, look.depth, look.alpha

    def compute():
        options = {"max_side": run.config.io.max_side, "config": run.config.localize, "progress": _steps_of(progress)}
        return _packed(align_later(run.capture, run.found, view, **options))

    found, on_renders = _unpacked(*store.run("align", key, compute)), set()
    for photograph in found.photographs:
        name, agree = photograph.name, f"{photograph.inliers} patches agree"
        if photograph.status == "rejected":
            progress.warn(f"{name}: left out, {photograph.reason}")
        elif name not in run.cameras:
            on_renders.add(name)
            progress.warn(f"{name}: placed by renders of the first visit after all, {agree}")
        elif name in found.cameras and not _same_pose(run.cameras[name], found.cameras[name]):
            on_renders.add(name)
            progress.warn(f"{name}: its pose was rough, mended on renders of the first visit, {agree}")
    return Run(found.apply(run.capture), found, run.config, run.seed, frozenset(on_renders))


def _same_pose(a: Camera, b: Camera) -> bool:
    return np.array_equal(a.cam_from_world.as_matrix(), b.cam_from_world.as_matrix())


def _steps_of(progress):
    return lambda what, done, total: progress.step(done, total, what)


def _packed(found: Localization) -> tuple[dict[str, np.ndarray], dict]:
    """A localisation as a stage keeps it."""
    names = sorted(found.cameras)
    poses = [found.cameras[n].cam_from_world for n in names]
    arrays = {
        "quat": np.stack([np.asarray(pose.quat) for pose in poses]),
        "xyz": np.stack([np.asarray(pose.xyz) for pose in poses]),
        "K": np.stack([np.asarray(found.cameras[n].K) for n in names]),
        "size": np.asarray([[found.cameras[n].width, found.cameras[n].height] for n in names]),
    }
    statuses = [dataclasses.asdict(s) for s in found.photographs]
    counts = {kind: sum(s["status"] == kind for s in statuses) for kind in ("given", "localized", "rejected")}
    lenses = {name: dataclasses.asdict(lens) for name, lens in found.lenses.items()}
    return arrays, {"names": names, "statuses": statuses, "lenses": lenses, "counts": counts}


def _unpacked(arrays: dict[str, np.ndarray], notes: dict) -> Localization:
    """What `_packed` kept."""
    poses = [SE3(jnp.asarray(quat), jnp.asarray(xyz)) for quat, xyz in zip(arrays["quat"], arrays["xyz"], strict=True)]
    cameras = {
        name: Camera(pose, jnp.asarray(K), int(width), int(height))
        for name, pose, K, (width, height) in zip(notes["names"], poses, arrays["K"], arrays["size"], strict=True)
    }
    lenses = {name: CameraModel(**{**lens, "params": tuple(lens["params"])}) for name, lens in notes["lenses"].items()}
    return Localization(cameras, lenses, tuple(PhotographStatus(**s) for s in notes["statuses"]))
