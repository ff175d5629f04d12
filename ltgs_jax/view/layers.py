"""What the browser is sent: splats as covariances and plain colours, poses between visits, where to look from."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation, Slerp

from ltgs_jax.geometry import C0, Camera
from ltgs_jax.scene import Chronology, Splats

_VISIBLE_OPACITY = 1 / 255


@dataclass(frozen=True)
class Layer:
    """Splats for the browser, colour without view dependence; those too faint to be drawn are left out."""

    centers: Float[np.ndarray, "m 3"]
    covariances: Float[np.ndarray, "m 3 3"]
    rgbs: Float[np.ndarray, "m 3"]
    opacities: Float[np.ndarray, "m 1"]

    def tinted(self, color: tuple[int, int, int], *, strength: float = 0.6) -> Float[np.ndarray, "m 3"]:
        """The colours mixed with an sRGB colour."""
        return (1 - strength) * self.rgbs + strength * np.asarray(color, np.float32) / 255


def layer_of(splats: Splats) -> Layer:
    """Splats as the browser wants them."""
    opacities = np.asarray(splats.opacities, np.float32)
    shown = opacities >= _VISIBLE_OPACITY
    quats = np.asarray(splats.quats, np.float64)[shown]
    quats[~quats.any(axis=1)] = (1, 0, 0, 0)
    axes = Rotation.from_quat(quats, scalar_first=True).as_matrix().astype(np.float32)
    axes *= np.exp(np.asarray(splats.log_scales, np.float32)[shown])[:, None, :]
    return Layer(
        centers=np.asarray(splats.means, np.float32)[shown],
        covariances=axes @ axes.swapaxes(1, 2),
        rgbs=np.clip(C0 * np.asarray(splats.sh, np.float32)[shown, 0] + 0.5, 0, 1),
        opacities=opacities[shown, None],
    )


@dataclass(frozen=True)
class Place:
    """Pose of an object in the world, wxyz and xyz, and whether it is there."""

    wxyz: Float[np.ndarray, "4"]
    xyz: Float[np.ndarray, "3"]
    visible: bool


def place_at(chronology: Chronology, k: int, time: float) -> Place:
    """Template `k` at a time between visits: between two visits at which it is there it goes the straight way."""
    start, end = int(np.floor(time)), int(np.ceil(time))
    poses = chronology.world_from_template
    quats = np.asarray(poses.quat, np.float64)[[start, end], k]
    places = np.asarray(poses.xyz, np.float64)[[start, end], k]
    visible = np.asarray(chronology.visible)[[start, end], k]
    part = time - start
    nearest = round(part)
    if not visible.all() or start == end:
        quat = quats[nearest] / np.linalg.norm(quats[nearest])
        return Place(quat, places[nearest], bool(visible[nearest]))
    between = Slerp([0, 1], Rotation.from_quat(quats, scalar_first=True))(part)
    return Place(between.as_quat(scalar_first=True), (1 - part) * places[0] + part * places[1], True)


@dataclass(frozen=True)
class Viewpoint:
    """Where a camera stands and looks, in the world."""

    position: Float[np.ndarray, "3"]
    wxyz: Float[np.ndarray, "4"]
    fov: float
    """Vertical field of view in radians."""
    aspect: float
    """Width over height."""


def viewpoint_of(camera: Camera) -> Viewpoint:
    """The pose and field of view of a photograph's camera."""
    world_from_cam = camera.cam_from_world.inverse()
    quat = np.asarray(world_from_cam.quat, np.float64)
    fov = 2 * np.arctan2(camera.height / 2, float(camera.K[1, 1]))
    return Viewpoint(
        np.asarray(world_from_cam.xyz, np.float64),
        quat / np.linalg.norm(quat),
        float(fov),
        camera.width / camera.height,
    )


def extent_of(layer: Layer) -> tuple[Float[np.ndarray, "3"], float]:
    """Middle of the splats and how far half of them reach from it, heedless of strays."""
    if not len(layer.centers):
        return np.zeros(3), 1.0
    middle = np.median(layer.centers, axis=0)
    return middle, float(np.median(np.linalg.norm(layer.centers - middle, axis=1))) or 1.0
