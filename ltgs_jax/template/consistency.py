"""Where in a volume the photographs agree on a colour: there a surface is likely."""

from collections.abc import Sequence
from itertools import combinations

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from ltgs_jax.match import Cone


def surface_evidence(
    centers: Float[np.ndarray, "n 3"],
    solid: Bool[np.ndarray, "x y z"],
    cones: Sequence[Cone],
    photographs: Sequence[Float[np.ndarray, "h w 3"]],
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, " n"]]:
    """Colour of each voxel, and the difference (root mean square, 0…1) of the two photographs that agree best on it.

    `centers` in C order of `solid`. Differences are averaged over patches of 3 × 3 voxels, along whichever plane of the
    grid agrees best: a surface agrees along itself, a place in front of or behind it does not. A voxel that one
    photograph alone sees disagrees as the usual voxel does.
    """
    colors = np.stack([_sampled(centers, cone, photo) for cone, photo in zip(cones, photographs, strict=True)])
    least = np.full(len(centers), np.inf)
    shown = np.isfinite(colors)
    color = np.sum(np.where(shown, colors, 0), axis=0) / np.maximum(shown.sum(axis=0), 1)
    for a, b in combinations(range(len(colors)), 2):
        square = np.mean((colors[a] - colors[b]) ** 2, axis=-1)
        known = np.isfinite(square)
        values = np.where(known, square, 0).reshape(solid.shape)
        weight = known.reshape(solid.shape).astype(float)
        for axis in range(3):
            size = tuple(1 if i == axis else 3 for i in range(3))
            total = ndimage.uniform_filter(weight, size, mode="constant")
            patch = np.maximum(ndimage.uniform_filter(values, size, mode="constant"), 0) / np.maximum(total, 1e-9)
            patch = np.where(known, patch.ravel(), np.inf)
            better = patch < least
            least = np.where(better, patch, least)
            color[better] = 0.5 * (colors[a] + colors[b])[better]
    spread = np.sqrt(least)
    inside = solid.ravel() & np.isfinite(spread)
    if inside.any():
        spread = np.where(np.isfinite(spread), spread, np.median(spread[inside]))
    return color, spread


def _sampled(points: Float[np.ndarray, "n 3"], cone: Cone, photograph: Float[np.ndarray, "h w 3"]) -> np.ndarray:
    """The photograph's colour at each point, NaN where the point does not fall on the silhouette."""
    x, y, z = (np.concatenate([points, np.ones((len(points), 1))], axis=1) @ cone.projection.T).T
    safe = np.where(z > 1e-6, z, 1)
    column, row = x / safe - 0.5, y / safe - 0.5
    h, w = cone.silhouette.shape
    nearest_row, nearest_column = np.rint(row).astype(int), np.rint(column).astype(int)
    inside = (z > 1e-6) & (nearest_row >= 0) & (nearest_row < h) & (nearest_column >= 0) & (nearest_column < w)
    inside[inside] &= cone.silhouette[nearest_row[inside], nearest_column[inside]]
    channels = [ndimage.map_coordinates(photograph[..., c], [row, column], order=1, mode="nearest") for c in range(3)]
    return np.where(inside[:, None], np.stack(channels, axis=-1), np.nan)
