"""Pose of one rigid object from matches with all photographs of a visit at once."""

import zlib  # noqa: F401  (before pycolmap, whose own zlib otherwise takes over the process and aborts it)

import numpy as np
import pycolmap
from jaxtyping import Bool, Float, Int

_LEAST = 4  # matches of which a pose may be made: three, and one that agrees


def object_pose(
    xy: Float[np.ndarray, "n 2"],
    points: Float[np.ndarray, "n 3"],
    view: Int[np.ndarray, " n"],
    cam_from_world: Float[np.ndarray, "v 3 4"],
    K: Float[np.ndarray, "v 3 3"],
    *,
    size: int,
    max_error: float,
    seed: int = 0,
) -> tuple[Float[np.ndarray, "3 4"], Bool[np.ndarray, " n"]] | None:
    """world_from_object of an object whose `points` show at pixels `xy` of the views `view`, most of them wrongly; and
    which agree within `max_error` pixels. None where no four do.

    The views are one rig, of which the object is the world: generalised absolute pose by RANSAC (GP3P, of pycolmap).
    `size`: width and height of the views in pixels. Deterministic for a given `seed`.
    """
    if len(xy) < _LEAST:
        return None
    options = pycolmap.RANSACOptions()
    options.max_error, options.random_seed = max_error, seed
    options.min_inlier_ratio, options.min_num_trials, options.max_num_trials = 0.02, 500, 5000
    found = pycolmap.estimate_and_refine_generalized_absolute_pose(
        np.asarray(xy, np.float64),
        np.asarray(points, np.float64),
        [int(i) for i in view],
        [pycolmap.Rigid3d(np.asarray(pose, np.float64)) for pose in cam_from_world],
        [_camera(k, size) for k in np.asarray(K, np.float64)],
        options,
    )
    if found is None:
        return None
    agreed = np.asarray(found["inlier_mask"], bool)
    return (found["rig_from_world"].matrix(), agreed) if agreed.sum() >= _LEAST else None


def _camera(K: Float[np.ndarray, "3 3"], size: int) -> pycolmap.Camera:
    return pycolmap.Camera(model="PINHOLE", width=size, height=size, params=[K[0, 0], K[1, 1], K[0, 2], K[1, 2]])
