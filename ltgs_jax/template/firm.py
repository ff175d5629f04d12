"""What of a new object's splats is the object, and what only mends the ground around it."""

import jax
import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage
from scipy.spatial import cKDTree

from ltgs_jax.geometry import Camera
from ltgs_jax.scene import Splats

from .cut import components
from .locate import Crop, backdrop_unlikeness

_PADDED = 2048  # places are projected in multiples of this many
_FIRM = 0.65  # of the upper quartile of unlikeness: where Otsu's threshold fell on objects of several scenes


def firm_part(splats: Splats, crop: Crop) -> tuple[Bool[np.ndarray, " n"], Bool[np.ndarray, "v s s"]]:
    """The splats that are a new object, and its outlines in the windows.

    The others only mend the ground around it: shadows, what something had hidden.
    A splat is firm when every window that sees its place was clearly unlike the photograph without the object; the
    largest connected piece of these is the object, with all that lies within its outlines.
    """
    means = np.asarray(splats.means, np.float64)
    unlike = np.stack([ndimage.gaussian_filter(u, 1.0) for u in backdrop_unlikeness(crop)])
    seen, rows, columns = _pixels_of(means, crop)
    views = np.arange(len(unlike))[:, None]
    least = np.where(seen, unlike[views, rows, columns], np.inf).min(axis=0)
    shown = (np.asarray(splats.opacities) > 0.1) & np.isfinite(least)
    if shown.sum() < 8:
        return np.ones(len(means), bool), np.asarray(crop.region)
    firm = np.flatnonzero(shown & (least > _FIRM * np.quantile(least[shown], 0.75)))
    spacing = np.median(cKDTree(means[firm]).query(means[firm], k=min(4, len(firm)))[0][:, -1])
    largest = firm[components(means[firm], 3 * spacing) == 0]
    outlines = np.zeros(unlike.shape, bool)
    for view, outline in enumerate(outlines):
        inside = largest[seen[view, largest]]
        outline[rows[view, inside], columns[view, inside]] = True
        outlines[view] = ndimage.binary_fill_holes(ndimage.binary_closing(np.pad(outline, 4), iterations=3))[4:-4, 4:-4]
    within = outlines[views, rows, columns] | ~seen
    return within.all(axis=0) & seen.any(axis=0), outlines


_project = jax.jit(jax.vmap(Camera.project, (0, None)))


def _pixels_of(means: Float[np.ndarray, "n 3"], crop: Crop) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Whether each window sees the place of each splat, and the row and column of the pixel that does, all [v n]."""
    padded = np.pad(means, ((0, -len(means) % _PADDED), (0, 0))).astype(np.float32)  # few shapes, few programs
    xy, z = (x[:, : len(means)] for x in _project(crop.camera, padded))
    size = crop.camera.width
    column, row = np.floor(np.nan_to_num(np.moveaxis(np.asarray(xy), -1, 0), nan=-1.0)).clip(-1, size).astype(int)
    seen = (np.asarray(z) > 1e-3) & (row >= 0) & (row < size) & (column >= 0) & (column < size)
    row, column = row.clip(0, size - 1), column.clip(0, size - 1)
    views = np.arange(len(seen))[:, None]
    behind = np.asarray(crop.depth)[views, row, column]
    tolerance = 0.1 * np.linalg.norm(np.ptp(means, axis=0))
    seen &= np.asarray(crop.valid)[views, row, column] & ((np.asarray(z) < behind + tolerance) | (behind <= 0))
    return seen, row, column
