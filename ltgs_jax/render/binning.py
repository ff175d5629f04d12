"""Which splats reach which tiles, front to back."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, UInt

from .grid import Grid, drop_inactive, tile_boxes
from .project import Projected


class Bins(eqx.Module):
    """Splats of every tile: those of tile t are `splats[starts[t] : starts[t] + counts[t]]`, front to back.

    `overflow` counts the pairs that did not fit.
    """

    splats: Int[Array, " i"]
    starts: Int[Array, " tiles"]
    counts: Int[Array, " tiles"]
    overflow: Int[Array, ""]


def depth_order(projected: Projected) -> Int[Array, " m"]:
    """Indices by increasing depth, equal depths by index, culled splats last.

    Sorting keys alone is 5–7 times faster on CPUs than carrying a payload (fact 9 of the conventions), so the index
    rides in the key. Float32 splats take one sort of their float64 depths, cut to the bits that the index leaves (a
    relative 1e-10 for a million splats, far below what float32 means resolve); float64 splats take two stable sorts,
    low bits first, and lose nothing.
    """
    high, low = (projected.depth_words[:, j] for j in range(2))
    high = jnp.where(projected.visible, high, jnp.uint32(0x7FFFFFFF))
    count = projected.depths.shape[0]
    index_bits = max(count - 1, 1).bit_length()
    with jax.enable_x64(True):
        index = jnp.arange(count, dtype=jnp.uint64)
        if projected.depths.dtype == jnp.float32:
            # The sign bit is 0 and makes way.
            bits = ((high.astype(jnp.uint64) << jnp.uint64(32)) | low.astype(jnp.uint64)) << jnp.uint64(1)
            kept = bits & jnp.uint64((1 << 64) - (1 << index_bits))
            return _low_word(jnp.sort(kept | index) & jnp.uint64((1 << index_bits) - 1))
        by_low = _low_word(jnp.sort((low.astype(jnp.uint64) << jnp.uint64(32)) | index))
        position = _low_word(jnp.sort((high[by_low].astype(jnp.uint64) << jnp.uint64(32)) | index))
        return by_low[position]


def _low_word(packed: UInt[Array, " m"]) -> Int[Array, " m"]:
    """The lower 32 bits as int32."""
    return (packed & jnp.uint64(0xFFFFFFFF)).astype(jnp.uint32).astype(jnp.int32)


def _reaches(facts: Float[Array, "i 6"], corner: tuple[Float[Array, " i"], ...], side: int) -> Bool[Array, " i"]:
    """Whether the ellipse α ≥ 1/255 of a splat meets the pixel centres' rectangle of a tile of `side` pixels.

    The exponent is convex: outside of the rectangle its minimum lies on one of the two edges that face the centre.
    """
    mean_x, mean_y, inverse_a, slope, inverse_b, reach = (facts[:, j] for j in range(6))
    x0, y0 = corner[0] + 0.5 - mean_x, corner[1] + 0.5 - mean_y
    x1, y1 = x0 + (side - 1), y0 + (side - 1)
    near_x, near_y = jnp.clip(0, x0, x1), jnp.clip(0, y0, y1)

    def exponent(dx, dy):
        return 0.5 * ((dx * inverse_a) ** 2 + ((dy - slope * dx) * inverse_b) ** 2)

    on_vertical = exponent(near_x, jnp.clip(slope * near_x, y0, y1))
    # Along the row dy = near_y the exponent's minimum in dx.
    weight = (slope * inverse_b) ** 2
    along = slope * inverse_b**2 / (inverse_a**2 + weight) * near_y
    on_horizontal = exponent(jnp.clip(along, x0, x1), near_y)
    return jnp.minimum(on_vertical, on_horizontal) <= reach * 1.0001 + 0.001


def bin_splats(projected: Projected, grid: Grid, capacity: int, active: Int[Array, " tiles"] | None = None) -> Bins:
    """Bin m = cameras·n splats, camera by camera, into the tiles that they reach.

    `active` (optional) is nonzero for the tiles that are wanted; others stay empty. Not differentiable.
    """
    m = projected.depths.shape[0]
    if m == 0:
        empty = jnp.zeros(grid.count, jnp.int32)
        return Bins(jnp.zeros(1, jnp.int32), empty, empty, jnp.zeros((), jnp.int32))
    projected = jax.lax.stop_gradient(projected)
    order = depth_order(projected)
    rank = jnp.zeros(m, jnp.int32).at[order].set(jnp.arange(m, dtype=jnp.int32), unique_indices=True)
    boxes = tile_boxes(projected, grid)
    boxes = boxes if active is None else drop_inactive(boxes, grid, active)
    wide, high = boxes[:, 2] - boxes[:, 0], boxes[:, 3] - boxes[:, 1]
    with jax.enable_x64(True):
        counts = (wide * high).astype(jnp.int64)
        ends = jnp.cumsum(counts)
        total = ends[-1]
        begins = jnp.minimum(ends - counts, capacity).astype(jnp.int32)
        overflow = jnp.clip(total - capacity, 0, 2**31 - 1).astype(jnp.int32)
        total = jnp.minimum(total, capacity).astype(jnp.int32)
    box_table = jnp.stack([boxes[:, 0], boxes[:, 1], wide, begins, rank], axis=-1)
    shape = jnp.stack([projected.inverse_a, projected.slope, projected.inverse_b, projected.reach], axis=-1)
    shape_table = jnp.concatenate([projected.means2d, shape], axis=-1)

    def sort_pairs(order, begins, box_table, shape_table):
        # Candidate pairs, splat by splat, so that all tables are read in order: slot i belongs to the last splat that
        # begins at or before it; count the beginnings.
        marks = jnp.zeros(capacity + 1, jnp.int32).at[begins].add(1)
        splat = jnp.cumsum(marks[:capacity]) - 1
        slot = jnp.arange(capacity, dtype=jnp.int32)
        left, top, width, begin, rank = (column[:, 0] for column in jnp.split(box_table[splat], 5, axis=-1))
        local, width = slot - begin, jnp.maximum(width, 1)
        row = local // width
        column, row = left + local - row * width, top + row
        tile = splat // (m // grid.cameras) * grid.per_camera + row * grid.columns + column
        corner = tuple(x.astype(shape_table.dtype) * grid.tile_size for x in (column, row))
        wanted = (slot < total) & _reaches(shape_table[splat], corner, grid.tile_size)
        if active is not None:
            wanted &= active[jnp.clip(tile, 0, grid.count - 1)] != 0
        tile = jnp.where(wanted, tile, grid.count)
        with jax.enable_x64(True):
            word = jnp.uint32 if (grid.count + 1) * m < 2**32 else jnp.uint64
            keys = jnp.sort(tile.astype(word) * word(m) + rank.astype(word))
            edges = jnp.searchsorted(keys, jnp.arange(grid.count + 1, dtype=word) * word(m)).astype(jnp.int32)
            splats = order[(keys % word(m)).astype(jnp.int32)]
        return splats, edges

    def no_pairs(*_):
        return jnp.zeros(capacity, jnp.int32), jnp.zeros(grid.count + 1, jnp.int32)

    # The branch also keeps XLA from fusing the tables into their gathers, where each entry would be computed per pair.
    splats, edges = jax.lax.cond(total > 0, sort_pairs, no_pairs, order, begins, box_table, shape_table)
    return Bins(splats, edges[:-1], edges[1:] - edges[:-1], overflow)
