"""The surface that an object stands on, found in the splats around it."""

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import ConvexHull, QhullError

from ltgs_jax.geometry import SE3

_STEEP = 0.02  # what a steep plane counts for beside a level one: things hang on walls, but rarely
_AT_ONCE = 1 << 20  # distances of points from planes
_ENOUGH = 500  # points that say on which side of a plane an object is
_LEVEL = np.radians(15)  # by which a surface that things stand on, or the guess of what is up, may be off


class Support(eqx.Module):
    """A plane normal·x = offset, its normal towards the cameras, with the residual noise of its points."""

    normal: Float[np.ndarray, "3"]
    offset: float
    noise: float

    def height(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """Signed distance of points above the plane, in scene units."""
        return points @ self.normal - self.offset

    def moved(self, pose: SE3) -> "Support":
        """The plane where a rigid motion takes it."""
        matrix = np.asarray(pose.as_matrix(), np.float64)
        normal = matrix[:3, :3] @ self.normal
        return Support(normal, self.offset + float(normal @ matrix[:3, 3]), self.noise)

    def frame(self) -> Float[np.ndarray, "3 3"]:
        """Rows: two axes in the plane and the normal."""
        seed = np.eye(3)[np.argmin(np.abs(self.normal))]
        u = np.cross(self.normal, seed)
        u /= np.linalg.norm(u)
        return np.stack([u, np.cross(self.normal, u), self.normal])  # right-handed

    def ring(self) -> Float[np.ndarray, "6 3"]:
        """Six unit vectors in the plane, all around."""
        u, v, _ = self.frame()
        return np.stack([np.cos(a) * u + np.sin(a) * v for a in np.arange(6) * np.pi / 3])


class Vantage(eqx.Module):
    """Where a visit's photographs were taken from: camera centres, and which way is up, as a unit vector."""

    centers: Float[np.ndarray, "c 3"]
    up: Float[np.ndarray, "3"]

    @classmethod
    def of_cameras(cls, world_from_cam: Float[np.ndarray, "c 4 4"]) -> "Vantage":
        """Up is what is level in all photographs, held upright: square to the cameras' x axes; from cameras side by
        side, that come near to one such axis, near to the mean of their own up."""
        right, own = world_from_cam[:, :3, 0], -world_from_cam[:, :3, 1]
        mean = own.mean(axis=0)
        mean /= np.linalg.norm(mean) + 1e-12
        spread = right.T @ right / len(right) + 0.1 * (np.eye(3) - np.outer(mean, mean))
        up = np.linalg.eigh(spread)[1][:, 0]
        return cls(world_from_cam[:, :3, 3], up if up @ mean >= 0 else -up)


def rotation_about(axis: Float[np.ndarray, "3"], angle: float) -> Float[np.ndarray, "3 3"]:
    """Rotation by an angle in radians about a unit axis (Rodrigues)."""
    skew = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.eye(3) + np.sin(angle) * skew + (1 - np.cos(angle)) * skew @ skew


def fit_support(
    points: Float[np.ndarray, "n 3"],
    weights: Float[np.ndarray, " n"],
    above: Float[np.ndarray, "m 3"],
    vantage: Vantage,
    *,
    rng: np.random.Generator,
    trials: int = 400,
) -> Support | None:
    """The plane through most of `points` that has the points `above` and the cameras on its upper side, or None.

    RANSAC with a truncated loss whose bound is 2.5 % of the points' spread, then least squares on the inliers. A plane
    must have the object on its upper side and in touch with it, so that a wall behind it does not win over the table
    below; a level one is likelier than a steep one.
    """
    if len(points) < 12:
        return None
    center = np.average(points, axis=0, weights=weights)
    spread = np.sqrt(np.average(np.sum((points - center) ** 2, axis=1), weights=weights))
    bound = 0.025 * spread
    reach = 0.2 * np.linalg.norm(np.ptp(above, axis=0)) + 2 * bound
    above = above[:: max(1, len(above) // _ENOUGH)]
    chosen = rng.choice(len(points), (trials, 3), p=weights / weights.sum())
    a, b, c = np.moveaxis(points[chosen], 1, 0)
    normals = np.cross(b - a, c - a)
    lengths = np.linalg.norm(normals, axis=1)
    sound = lengths > 1e-9 * spread**2  # one point drawn twice spans none
    a, normals = a[sound], normals[sound] / lengths[sound, None]
    normals *= np.where(np.median((vantage.centers - a[:, None]) @ normals[..., None], axis=1) < 0, -1, 1)
    offsets = np.sum(normals * a, axis=1)
    scores = np.zeros(len(a))
    for part in np.array_split(np.arange(len(a)), 1 + len(a) * max(len(points), len(above)) // _AT_ONCE):
        distance = points @ normals[part].T - offsets[part]
        inlier = weights @ np.maximum(0, 1 - (distance / bound) ** 2)
        height = above @ normals[part].T - offsets[part]
        over = np.mean(height > -reach, axis=0)
        touch = np.exp(-0.5 * (np.quantile(height, 0.05, axis=0) / reach) ** 2)
        scores[part] = inlier * over**2 * touch
    angle = np.arccos(np.clip(normals @ vantage.up, -1, 1))
    scores *= np.maximum(_STEEP, np.exp(-0.5 * (angle / _LEVEL) ** 2))
    if scores.max(initial=0) <= 0:
        return None
    normal, a = normals[scores.argmax()], a[scores.argmax()]
    for _ in range(3):
        near = np.abs((points - a) @ normal) < bound
        if near.sum() < 6:
            return None
        a = np.average(points[near], axis=0, weights=weights[near])
        centered = (points[near] - a) * np.sqrt(weights[near])[:, None]
        refined = np.linalg.svd(centered, full_matrices=False)[2][2]
        normal = refined if refined @ normal > 0 else -refined
    near = np.abs((points - a) @ normal) < bound
    noise = float(1.4826 * np.median(np.abs((points[near] - a) @ normal))) + 1e-6 * spread
    return Support(normal, float(normal @ a), noise)


def convex_footprint(points: Float[np.ndarray, "n 2"], queries: Float[np.ndarray, "m 2"]) -> Bool[np.ndarray, " m"]:
    """Which queries lie within the convex hull of points in the plane."""
    try:
        edges = ConvexHull(points).equations
    except (QhullError, ValueError):  # fewer than three points, or all in a line
        return np.zeros(len(queries), bool)
    return np.all(queries @ edges[:, :2].T + edges[:, 2] <= 0, axis=1)
