"""Splats of every tile laid out in rounds, as the compositor takes them."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from .binning import Bins
from .config import RenderConfig
from .grid import Grid
from .project import Projected

TABLE_SHAPE = 8  # columns of a table before its channels: mean, remainder, inverse_a, slope, inverse_b, opacity
GROUP = 4  # splats of a round are scanned in groups of this many


@dataclasses.dataclass(frozen=True)
class Schedule:
    """Static sizes of the blending loops: tiles are taken in blocks, a block advances `chunk` splats per round.

    `rounds` is the capacity over all blocks.
    """

    tile_size: int
    chunk: int
    tiles_per_block: int
    rounds: int


class Blocks(eqx.Module):
    """First round and number of rounds of each block of tiles."""

    offsets: Int[Array, " b"]
    limits: Int[Array, " b"]


class Slots(eqx.Module):
    """Where everything goes: `index` [r t k] the splat (a row of the table) of each slot of each round, `centres`
    [r t 2] the centre of each tile in pixels, `order` the tiles in the order of the blocks, `dropped` pairs for which
    the plan had no rounds."""

    blocks: Blocks
    index: Int[Array, "r t k"]
    centres: Float[Array, "r t 2"]
    order: Int[Array, " tiles"]
    dropped: Int[Array, ""]


def tiles_per_block(config: RenderConfig, tiles: int) -> int:
    """Tiles that advance together: few on a CPU, where a block stays in the cache; all on other devices."""
    wanted = config.tiles_per_block
    if wanted is None:
        wanted = 64 if jax.default_backend() == "cpu" else tiles
    return max(1, min(wanted, tiles))


def block_rounds(counts: Int[Array, " tiles"], block: int, chunk: int) -> tuple[Int[Array, " tiles"], Int[Array, " b"]]:
    """Tiles by decreasing count, padded to whole blocks (with index `tiles`), and the rounds of each block."""
    tiles = counts.shape[0]
    padding = -tiles % block
    with jax.enable_x64(True):
        inverse = jnp.uint64(0xFFFFFFFF) - counts.astype(jnp.uint64)
        packed = jnp.sort((inverse << jnp.uint64(32)) | jnp.arange(tiles, dtype=jnp.uint64))
        order = (packed & jnp.uint64(0xFFFFFFFF)).astype(jnp.int32)
    order = jnp.concatenate([order, jnp.full(padding, tiles, jnp.int32)])
    return order, -(-counts[order[::block]] // chunk)


def lay_out(bins: Bins, grid: Grid, tiles: Int[Array, " t"] | None, schedule: Schedule, empty: int, dtype) -> Slots:
    """Lay the splats out in rounds: blocks of tiles of similar length, `chunk` splats of each tile at a time."""
    chosen = jnp.arange(grid.count, dtype=jnp.int32) if tiles is None else tiles
    known = (chosen >= 0) & (chosen < grid.count)
    tile = jnp.where(known, chosen, 0)
    counts = jnp.where(known, bins.counts[tile], 0)
    order, rounds = block_rounds(counts, schedule.tiles_per_block, schedule.chunk)
    offsets = jnp.minimum(jnp.cumsum(rounds) - rounds, schedule.rounds)
    limits = jnp.minimum(rounds, schedule.rounds - offsets)

    facts = jnp.stack([bins.starts[tile], counts, *grid.origins()[tile % grid.per_camera].T], axis=-1)
    facts = jnp.pad(facts, ((0, 1), (0, 0)))[order].reshape(-1, schedule.tiles_per_block, 4)
    dropped = jnp.sum(jnp.maximum(facts[..., 1] - limits[:, None] * schedule.chunk, 0))
    row = jnp.arange(schedule.rounds, dtype=jnp.int32)
    # The last block that begins at or before a row; blocks without rounds begin where the next one does.
    block = jnp.searchsorted(offsets, row, side="right").astype(jnp.int32) - 1
    facts = facts[block]
    place = (row - offsets[block])[:, None] * schedule.chunk + jnp.arange(schedule.chunk, dtype=jnp.int32)
    present = place[:, None] < facts[..., 1, None]
    pair = jnp.where(present, facts[..., 0, None] + place[:, None], 0)
    return Slots(
        blocks=Blocks(offsets, limits),
        index=jnp.where(present, bins.splats[pair], empty),
        centres=facts[..., 2:].astype(dtype) + schedule.tile_size / 2,
        order=order[: chosen.shape[0]],
        dropped=dropped.astype(jnp.int32),
    )


def make_table(projected: Projected) -> Float[Array, "m f"]:
    """One row per splat: mean and its remainder, shape, opacity, colours, depth; and an empty row for empty slots."""
    shape = [projected.inverse_a, projected.slope, projected.inverse_b, projected.opacities]
    columns = [projected.means2d, projected.remainders, jnp.stack(shape, axis=-1), projected.colors]
    columns.append(projected.depths[:, None])
    return jnp.pad(jnp.concatenate(columns, axis=-1), ((0, 1), (0, 0)))


def channel_count(table: Float[Array, "m f"]) -> int:
    """Blended channels of a table, the depth among them."""
    return table.shape[1] - TABLE_SHAPE


def round_forms(
    rows: Float[Array, "t k f"], centres: Float[Array, "t 2"]
) -> tuple[tuple[Float[Array, "t q g"], ...], tuple[Float[Array, "t q g"], ...]]:
    """What the splats of a round, rows of the table, are to their tiles: the forms of the exponent and the opacity,
    (p0, p1, q0, q1, q2, opacity), and the channels; splats in q groups of `GROUP`.

    At offset (x, y) from the tile's centre the exponent is −½(p² + q²) with p = p0 + p1·x and q = q0 + q1·x + q2·y.
    Relative to the tile's centre p and q stay small wherever α ≥ 1/255, so that neither they nor the moments of the
    gradient cancel. Empty slots have opacity 0.
    """
    # Split, not indexed: the transpose of a split is one concatenation, that of an index a padded array per column.
    columns = [column.reshape(rows.shape[0], -1, GROUP) for column in jnp.split(rows, rows.shape[-1], axis=-1)]
    mean_x, mean_y, rest_x, rest_y, inverse_a, slope, inverse_b, opacity, *channels = columns
    # The remainder comes last: the difference before it is exact near the splat.
    dx = (centres[:, 0, None, None] - mean_x) - rest_x
    dy = (centres[:, 1, None, None] - mean_y) - rest_y
    p0, q0 = dx * inverse_a, (dy - slope * dx) * inverse_b
    return (p0, inverse_a, q0, -slope * inverse_b, inverse_b, opacity), tuple(channels)
