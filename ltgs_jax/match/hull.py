"""The volume that an unexplained object can occupy: the visual hull of its outlines, in front of what is known."""

from collections.abc import Sequence

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float, Int


class Cone(eqx.Module):
    """One photograph's evidence: projection, silhouette of what came, and the depth of what is known behind it."""

    projection: Float[np.ndarray, "3 4"]
    silhouette: Bool[np.ndarray, "h w"]
    valid: Bool[np.ndarray, "h w"]
    depth: Float[np.ndarray, "h w"]


class Grid(eqx.Module):
    """A box of voxels along the axes `frame` (rows) from `origin`, of edge `voxel` in scene units."""

    origin: Float[np.ndarray, "3"]
    frame: Float[np.ndarray, "3 3"]
    voxel: float
    shape: tuple[int, int, int] = eqx.field(static=True)

    def centers(self) -> Float[np.ndarray, "m 3"]:
        """World positions of all voxel centres, in C order."""
        index = np.stack(np.meshgrid(*[np.arange(n) + 0.5 for n in self.shape], indexing="ij"), axis=-1).reshape(-1, 3)
        return (index * self.voxel) @ self.frame + self.origin


def grid_around(points: Float[np.ndarray, "n 3"], frame: Float[np.ndarray, "3 3"], *, resolution: int) -> Grid:
    """The smallest box along `frame` around points, with `resolution` voxels along its longest edge."""
    local = points @ frame.T
    low, high = local.min(axis=0), local.max(axis=0)
    voxel = float((high - low).max() / resolution) or 1e-6
    shape = tuple(int(n) for n in np.maximum(1, np.ceil((high - low) / voxel)))
    return Grid(low @ frame, frame, voxel, shape)


def carve(points: Float[np.ndarray, "n 3"], cones: Sequence[Cone], *, tolerance: float) -> Int[np.ndarray, "n 2"]:
    """For each point, in how many photographs it falls on a silhouette, and in how many it falls beside one.

    A photograph in which the point is out of frame, masked, or behind the known surface by more than `tolerance`
    (scene units) has no say.
    """
    counts = np.zeros((len(points), 2), int)
    homogeneous = np.concatenate([points, np.ones((len(points), 1))], axis=1)
    for cone in cones:
        x, y, z = (homogeneous @ cone.projection.T).T
        h, w = cone.silhouette.shape
        safe = np.where(z > 1e-6, z, 1)
        column, row = np.floor(x / safe).astype(int), np.floor(y / safe).astype(int)
        seen = (z > 1e-6) & (column >= 0) & (column < w) & (row >= 0) & (row < h)
        column, row = np.where(seen, column, 0), np.where(seen, row, 0)
        seen &= cone.valid[row, column] & (z < cone.depth[row, column] + tolerance)
        on = cone.silhouette[row, column]
        counts[:, 0] += seen & on
        counts[:, 1] += seen & ~on
    return counts
