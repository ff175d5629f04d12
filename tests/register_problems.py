"""Registration problems with known answers, made here."""

import numpy as np
from scipy.spatial.transform import Rotation

from ltgs_jax.geometry import SE3


def motion(rng) -> tuple[np.ndarray, np.ndarray]:
    """A random rotation and translation."""
    return Rotation.random(random_state=int(rng.integers(1 << 31))).as_matrix(), rng.normal(size=3)


def surface(rng, count: int) -> np.ndarray:
    """Points of a lopsided closed surface of size about 1."""
    directions = rng.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    radius = 0.35 + 0.1 * directions[:, 0] * directions[:, 1] + 0.1 * directions[:, 2] ** 3
    return directions * radius[:, None] * np.array([1.0, 0.8, 0.6])


def problem(seed: int, count: int, outliers: float, sigma: float = 0.005):
    """src, dst, R, t and the inlier mask; outliers are right points of the object at wrong places."""
    rng = np.random.default_rng(seed)
    src = surface(rng, count)
    rotmat, xyz = motion(rng)
    wrong = rng.permutation(count) < round(outliers * count)
    partner = np.arange(count)
    partner[wrong] = np.roll(partner[wrong], 1)
    dst = src[partner] @ rotmat.T + xyz + sigma * rng.normal(size=src.shape)
    return src, dst, rotmat, xyz, ~wrong


def angle(answer: SE3, rotmat: np.ndarray) -> float:
    """Angle in degrees between a motion's rotation and a matrix."""
    return np.degrees(Rotation.from_matrix(np.asarray(answer.rotmat(), np.float64).T @ rotmat).magnitude())
