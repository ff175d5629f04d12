"""Local rendering: from a changed region to tiles, and between images and patches."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .config import RenderConfig
from .grid import Grid


def tiles_of_mask(mask: Bool[np.ndarray, "h w"], *, config: RenderConfig | None = None) -> Int[Array, " t"]:
    """Row-major indices of the tiles that hold a true pixel, for the `tiles` of `render`; outside of jit only.

    Padded with −1 to a power of two, so that regions of similar size share a program.
    """
    size = (config or RenderConfig()).tile_size
    mask = np.asarray(mask, bool)
    grid = Grid(mask.shape[1], mask.shape[0], size, 1)
    padded = np.zeros((grid.rows * size, grid.columns * size), bool)
    padded[: mask.shape[0], : mask.shape[1]] = mask
    held = padded.reshape(grid.rows, size, grid.columns, size).any(axis=(1, 3)).ravel()
    tiles = np.flatnonzero(held)
    room = 1 << max(int(tiles.size) - 1, 0).bit_length()
    return jnp.asarray(np.concatenate([tiles, np.full(room - tiles.size, -1)]), jnp.int32)


def _pixels(width: int, height: int, tiles: Int[Array, " t"], size: int) -> tuple[Int[Array, "t s s"], ...]:
    """Rows and columns of the pixels of tiles; a place outside of the image for padding and beyond the border."""
    columns = -(-width // size)
    side = jnp.arange(size, dtype=jnp.int32)
    row = (tiles // columns)[:, None, None] * size + side[:, None]
    column = (tiles % columns)[:, None, None] * size + side
    outside = (tiles[:, None, None] < 0) | (row >= height) | (column >= width)
    return jnp.where(outside, height, row), jnp.where(outside, width, column)


def gather_tiles(
    image: Float[Array, "h w *ch"], tiles: Int[Array, " t"], *, config: RenderConfig | None = None
) -> Float[Array, "t s s *ch"]:
    """Patches of an image in the layout that `render` gives for `tiles`; 0 outside of the image."""
    row, column = _pixels(image.shape[1], image.shape[0], tiles, (config or RenderConfig()).tile_size)
    return image.at[row, column].get(mode="fill", fill_value=0)


def scatter_tiles(
    image: Float[Array, "h w *ch"],
    tiles: Int[Array, " t"],
    patches: Float[Array, "t s s *ch"],
    *,
    config: RenderConfig | None = None,
) -> Float[Array, "h w *ch"]:
    """An image with the patches of `tiles` put in their places."""
    row, column = _pixels(image.shape[1], image.shape[0], tiles, (config or RenderConfig()).tile_size)
    return image.at[row, column].set(patches, mode="drop")
