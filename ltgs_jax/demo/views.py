"""Cameras round the table."""

import dataclasses

import numpy as np
from scipy.spatial.transform import Rotation

from ltgs_jax.io import CameraModel

from .room import TABLE_TOP

_ARC = np.radians(105.0)  # to either side of the table's front
_ELEVATION = np.radians([16.0, 54.0])
_DISTANCE = (1.28, 1.7)


@dataclasses.dataclass(frozen=True)
class View:
    """A pose: `world_from_cam` rotation [3 3] (x right, y down, z forward) and the camera's centre [3] in metres."""

    rotation: np.ndarray
    centre: np.ndarray

    def cam_from_world(self) -> tuple[np.ndarray, np.ndarray]:
        """Quaternion wxyz and translation."""
        quat = Rotation.from_matrix(self.rotation.T).as_quat(canonical=True)[[3, 0, 1, 2]]
        return quat, -self.rotation.T @ self.centre

    def project(self, points: np.ndarray, lens: CameraModel) -> tuple[np.ndarray, np.ndarray]:
        """Pixels [n 2] and camera z [n]."""
        local = (points - self.centre) @ self.rotation
        K = lens.K()
        z = local[:, 2]
        return local[:, :2] / np.where(z > 1e-6, z, np.nan)[:, None] * np.diag(K)[:2] + K[:2, 2], z


def look_at(centre: np.ndarray, target: np.ndarray) -> View:
    """A camera at `centre` that looks at `target`, its x level."""
    forward = (target - centre) / np.linalg.norm(target - centre)
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    return View(np.stack([right, np.cross(forward, right), forward], axis=1), centre)


def _on_arc(rng: np.random.Generator, azimuth: float, elevation: float) -> View:
    target = np.array([0.0, 0.02, TABLE_TOP + 0.06]) + rng.normal(scale=[0.07, 0.05, 0.03])
    distance = rng.uniform(*_DISTANCE)
    direction = [np.sin(azimuth) * np.cos(elevation), -np.cos(azimuth) * np.cos(elevation), np.sin(elevation)]
    return look_at(target + distance * np.array(direction), target)


def dense_views(rng: np.random.Generator, count: int) -> list[View]:
    """Views spread evenly over the arc and over the heights (a golden-ratio sequence, jittered)."""
    start = rng.random(2)
    views = []
    for i in range(count):
        a, e = (start + i * np.array([0.7548776662, 0.5698402910])) % 1
        views.append(_on_arc(rng, (2 * a - 1) * _ARC, _ELEVATION[0] + e * np.ptp(_ELEVATION)))
    return views


def sparse_views(rng: np.random.Generator, count: int) -> list[View]:
    """A few views of a later visit, from sides as different as the arc allows."""
    azimuths = np.linspace(-0.8, 0.8, count) * _ARC + rng.normal(scale=0.12, size=count)
    return [_on_arc(rng, azimuth, rng.uniform(*np.radians([26, 46]))) for azimuth in azimuths]
