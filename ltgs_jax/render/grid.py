"""The tiles of an image, and the boxes of tiles that splats touch."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

from .project import Projected


class Grid(eqx.Module):
    """The tiles of one image, or of a batch of `cameras` equal ones, row by row; all fields static."""

    width: int = eqx.field(static=True)
    height: int = eqx.field(static=True)
    tile_size: int = eqx.field(static=True)
    cameras: int = eqx.field(static=True)

    @property
    def columns(self) -> int:
        """Tiles in a row."""
        return -(-self.width // self.tile_size)

    @property
    def rows(self) -> int:
        """Tiles in a column."""
        return -(-self.height // self.tile_size)

    @property
    def per_camera(self) -> int:
        """Tiles of one camera."""
        return self.columns * self.rows

    @property
    def count(self) -> int:
        """Tiles of all cameras."""
        return self.per_camera * self.cameras

    def origins(self) -> Int[Array, "tiles 2"]:
        """Pixel index (x, y) of the first pixel of every tile of one camera."""
        tile = jnp.arange(self.per_camera, dtype=jnp.int32)
        return jnp.stack([tile % self.columns, tile // self.columns], axis=-1) * self.tile_size

    def choose(self, tiles: Int[Array, "c t"]) -> tuple[Int[Array, " ct"], Int[Array, " tiles"]]:
        """Indices among the tiles of all cameras of the chosen tiles (−1 outside of the grid), and 1 where chosen."""
        first = jnp.arange(self.cameras, dtype=jnp.int32)[:, None] * self.per_camera
        inside = (tiles >= 0) & (tiles < self.per_camera)
        chosen = jnp.where(inside, tiles.astype(jnp.int32) + first, -1).reshape(-1)
        active = jnp.zeros(self.count, jnp.int32).at[jnp.where(chosen < 0, self.count, chosen)].set(1, mode="drop")
        return chosen, active


def tile_boxes(projected: Projected, grid: Grid) -> Int[Array, "m 4"]:
    """First and one-past-last tile column and row that the box of every splat touches; empty where culled."""
    # The margin covers rounding in the extents; the decision at α = 1/255 falls at the pixel.
    half = projected.extents * 1.0001 + 0.001
    size = jnp.asarray([grid.width, grid.height], half.dtype)
    centre = jax.lax.stop_gradient(projected.means2d)
    first = jnp.clip(jnp.ceil(centre - half - 0.5), 0, size).astype(jnp.int32)
    last = jnp.clip(jnp.floor(centre + half - 0.5), -1, size - 1).astype(jnp.int32)
    low = first // grid.tile_size
    high = last // grid.tile_size + 1
    empty = ~projected.visible[:, None] | (last < first)
    return jnp.concatenate([jnp.where(empty, 0, low), jnp.where(empty, 0, high)], axis=-1)


def drop_inactive(boxes: Int[Array, "m 4"], grid: Grid, active: Int[Array, " tiles"]) -> Int[Array, "m 4"]:
    """Empty the boxes that hold no active tile, by the sums of a summed-area table."""
    table = active.reshape(grid.cameras, grid.rows, grid.columns)
    table = jnp.pad(jnp.cumsum(jnp.cumsum(table, axis=1), axis=2), ((0, 0), (1, 0), (1, 0)))
    camera = jnp.repeat(jnp.arange(grid.cameras, dtype=jnp.int32), boxes.shape[0] // grid.cameras)
    x0, y0, x1, y1 = (boxes[:, j] for j in range(4))
    inside = table[camera, y1, x1] - table[camera, y0, x1] - table[camera, y1, x0] + table[camera, y0, x0]
    return jnp.where(inside[:, None] > 0, boxes, 0)
