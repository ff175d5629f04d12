"""Front-to-back blending of tiles, with its pushforward and its pull-back."""

import dataclasses
import functools

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.lax import Precision
from jaxtyping import Array, Float, Int

from .config import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_STOP

_SHAPE_COLUMNS = 6  # mean x, mean y, inverse_a, slope, inverse_b, opacity; the blended channels follow


@dataclasses.dataclass(frozen=True)
class Schedule:
    """Static sizes of the blending loops: tiles are taken in blocks, a block advances `chunk` splats per round."""

    tile_size: int
    chunk: int
    tiles_per_block: int
    rounds: int


class Lists(eqx.Module):
    """Blocks of tiles: `splats` [i] sorted by tile and depth; `starts`, `counts` [blocks tiles] into it; `origins`
    [blocks tiles 2] first pixel of each tile; `offsets`, `limits` [blocks] first round in the saved states, and number
    of rounds, of each block."""

    splats: Int[Array, " i"]
    starts: Int[Array, "b t"]
    counts: Int[Array, "b t"]
    origins: Float[Array, "b t 2"]
    offsets: Int[Array, " b"]
    limits: Int[Array, " b"]


def _pixel_offsets(tile_size: int, dtype) -> tuple[Float[Array, " p"], Float[Array, " p"]]:
    """Pixel centres of a tile relative to the tile's centre."""
    side = jnp.arange(tile_size, dtype=dtype) + jnp.asarray(0.5 - tile_size / 2, dtype)
    return jnp.tile(side, tile_size), jnp.repeat(side, tile_size)


def _forms(rows: Float[Array, "t k f"], origin: Float[Array, "t 2"], tile_size: int) -> list[Float[Array, "t k 1"]]:
    """The exponent at a tile's centre: ½(p² + q²) with p = p0 + p1·x and q = q0 + q1·x + q2·y, then the opacity.

    Relative to the tile's centre both forms stay small wherever α ≥ 1/255, so that neither they nor the moments of the
    gradient cancel.
    """
    centre = origin + tile_size / 2
    mean_x, mean_y, inverse_a, slope, inverse_b, opacity = (rows[:, :, j] for j in range(_SHAPE_COLUMNS))
    dx, dy = centre[:, None, 0] - mean_x, centre[:, None, 1] - mean_y
    p0, q0 = dx * inverse_a, (dy - slope * dx) * inverse_b
    return [v[..., None] for v in (p0, inverse_a, q0, -slope * inverse_b, inverse_b, opacity)]


def _alphas(rows, origin, present, tile_size: int) -> Float[Array, "t k p"]:
    """α of every splat of a chunk at every pixel of its tile, 0 where skipped."""
    p0, p1, q0, q1, q2, opacity = _forms(rows, origin, tile_size)
    x, y = _pixel_offsets(tile_size, rows.dtype)
    p, q = p0 + p1 * x, q0 + q1 * x + q2 * y
    alpha = jnp.minimum(opacity * jnp.exp(-0.5 * (p * p + q * q)), ALPHA_MAX)
    return jnp.where((alpha >= ALPHA_MIN) & present[..., None], alpha, 0)


def _weights(alphas: Float[Array, "t k p"], transmittance: Float[Array, "t p"]):
    """Effective α, weights αT and transmittances before each splat of a chunk, and the transmittance after it."""
    effective, weights, before = [], [], []
    for k in range(alphas.shape[1]):
        alpha = jnp.where(transmittance > TRANSMITTANCE_STOP, alphas[:, k], 0)
        weight = alpha * transmittance
        effective.append(alpha)
        weights.append(weight)
        before.append(transmittance)
        transmittance = transmittance - weight
    return effective, weights, before, transmittance


def _gather(table, lists: Lists, block, round_index, chunk: int):
    """Indices, presence and rows of the splats of one round of a block."""
    place = round_index * chunk + jnp.arange(chunk, dtype=jnp.int32)
    present = place < lists.counts[block][:, None]
    index = lists.splats[jnp.where(present, lists.starts[block][:, None] + place, 0)]
    return index, present, table[index]


def _channels(weights: list, rows: Float[Array, "t k f"]) -> Float[Array, "t ch p"]:
    """Σ over a chunk of weight times channel."""
    stacked = jnp.stack(weights, axis=1)
    return jnp.einsum("tkc,tkp->tcp", rows[..., _SHAPE_COLUMNS:], stacked, precision=Precision.HIGHEST)


def _blend(schedule: Schedule, table, lists: Lists, keep_states: bool):
    """Blend all blocks; with `keep_states` also the transmittance before every round and the rounds done."""
    blocks, tiles = lists.starts.shape
    pixels = schedule.tile_size**2
    channels = table.shape[1] - _SHAPE_COLUMNS
    states = jnp.ones((schedule.rounds if keep_states else 1, tiles, pixels), table.dtype)

    def block_step(states, block):
        def going(carry):
            round_index, transmittance, _, _ = carry
            return (round_index < lists.limits[block]) & jnp.any(transmittance > TRANSMITTANCE_STOP)

        def advance(carry):
            round_index, transmittance, total, states = carry
            if keep_states:
                states = jax.lax.dynamic_update_index_in_dim(
                    states, transmittance, lists.offsets[block] + round_index, 0
                )
            _, present, rows = _gather(table, lists, block, round_index, schedule.chunk)
            alphas = _alphas(rows, lists.origins[block], present, schedule.tile_size)
            _, weights, _, transmittance = _weights(alphas, transmittance)
            return round_index + 1, transmittance, total + _channels(weights, rows), states

        clear = jnp.ones((tiles, pixels), table.dtype)
        nothing = jnp.zeros((tiles, channels, pixels), table.dtype)
        first = jnp.zeros((), jnp.int32)
        done, transmittance, total, states = jax.lax.while_loop(going, advance, (first, clear, nothing, states))
        return states, (total, transmittance, done)

    states, (total, transmittance, done) = jax.lax.scan(block_step, states, jnp.arange(blocks, dtype=jnp.int32))
    return (total, transmittance), (states, done)


def _pull_back(schedule: Schedule, table, lists: Lists, states, done, final, cotangents):
    """Gradient of the table: blocks again, their rounds from back to front.

    With e_k = c_k·∂L/∂C and S_k = Σ_{j>k} w_j e_j + T_end ∂L/∂T_end, ∂L/∂α_k = T_k e_k − S_k / (1 − α_k). What reaches
    the six shape columns are the moments of −α ∂L/∂α over the tile's pixels, a product with one fixed matrix.
    """
    total_ct, transmittance_ct = cotangents
    x, y = _pixel_offsets(schedule.tile_size, table.dtype)
    monomials = jnp.stack([jnp.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)

    def block_step(gradient, block):
        origin, cotangent = lists.origins[block], total_ct[block]

        def retreat(carry):
            round_index, behind, gradient = carry
            round_index = round_index - 1
            before_all = jax.lax.dynamic_index_in_dim(states, lists.offsets[block] + round_index, keepdims=False)
            index, present, rows = _gather(table, lists, block, round_index, schedule.chunk)
            alphas = _alphas(rows, origin, present, schedule.tile_size)
            effective, weights, before, _ = _weights(alphas, before_all)
            channels = rows[..., _SHAPE_COLUMNS:]
            worth = jnp.einsum("tkc,tcp->tkp", channels, cotangent, precision=Precision.HIGHEST)
            pulls: list = [None] * schedule.chunk
            for k in reversed(range(schedule.chunk)):
                alpha = effective[k]
                pull = before[k] * worth[:, k] - behind / (1 - alpha)
                pulls[k] = jnp.where((alpha > 0) & (alpha < ALPHA_MAX), -alpha * pull, 0)
                behind = behind + weights[k] * worth[:, k]
            stacked = jnp.stack(weights, axis=1)
            channel_ct = jnp.einsum("tkp,tcp->tkc", stacked, cotangent, precision=Precision.HIGHEST)
            moments = jnp.matmul(jnp.stack(pulls, axis=1), monomials, precision=Precision.HIGHEST)
            rows_ct = jnp.concatenate([_shape_gradient(rows, origin, moments, schedule.tile_size), channel_ct], axis=-1)
            return round_index, behind, gradient.at[index].add(jnp.where(present[..., None], rows_ct, 0))

        behind = final[block] * transmittance_ct[block]
        carry = jax.lax.while_loop(lambda carry: carry[0] > 0, retreat, (done[block], behind, gradient))
        return carry[2], None

    return jax.lax.scan(block_step, jnp.zeros_like(table), jnp.arange(lists.starts.shape[0], dtype=jnp.int32))[0]


def _shape_gradient(rows, origin, moments, tile_size: int) -> Float[Array, "t k 6"]:
    """From the moments of ∂L/∂σ over a tile to the six shape columns, through p and q of `_forms`."""
    p0, p1, q0, q1, q2, opacity = (v[..., 0] for v in _forms(rows, origin, tile_size))
    one, x, y, xx, xy, yy = (moments[..., j] for j in range(6))
    p0_ct, p1_ct = p0 * one + p1 * x, p0 * x + p1 * xx
    q0_ct, q1_ct, q2_ct = q0 * one + q1 * x + q2 * y, q0 * x + q1 * xx + q2 * xy, q0 * y + q1 * xy + q2 * yy
    _, pull = jax.vjp(lambda shape: tuple(v[..., 0] for v in _forms(shape, origin, tile_size)[:5]), rows[..., :6])
    (shape_ct,) = pull((p0_ct, p1_ct, q0_ct, q1_ct, q2_ct))
    # α = opacity·exp(−σ): ∂L/∂opacity = Σ ∂L/∂α·α / opacity.
    return shape_ct.at[..., 5].set(-one / jnp.maximum(opacity, jnp.finfo(rows.dtype).tiny))


@jax.custom_jvp
def _first_order_only(x):
    """The identity; asking for its derivative, as second derivatives of `composite` would, is refused."""
    return x


@_first_order_only.defjvp
def _refuse(primals, tangents):
    raise NotImplementedError("render: second derivatives are not implemented; use render_reference on small scenes")


def _linear_map(push, pull, tangent, like, guard):
    """push(tangent), with `pull` as its transpose; batches, and transposes, as JAX's own linear operations do.

    Posed as the solution of the block-triangular system [1 0; −J 1][t; u] = [t; 0], that is u = J·t, whose transpose is
    solved by Jᵀ. JAX takes both solvers as given and looks at the system's own product only for second derivatives,
    where `guard` refuses.
    """
    zero = tangent.ravel()[0] * 0
    right_side = (tangent, tuple(jnp.broadcast_to(zero, leaf.shape) for leaf in like))
    still = guard.ravel()[0] * 0

    def product(tu):
        return jax.tree.map(lambda leaf: leaf + still * leaf, tu)

    def solve(_, tu):
        return tu[0], jax.tree.map(jnp.add, tu[1], push(tu[0]))

    def solve_transposed(_, tu):
        return tu[0] + pull(tu[1]), tu[1]

    return jax.lax.custom_linear_solve(product, right_side, solve, solve_transposed)[1]


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def composite(
    schedule: Schedule, table: Float[Array, "m f"], lists: Lists
) -> tuple[Float[Array, "b t ch p"], Float[Array, "b t p"]]:
    """Blended channels and final transmittance of every pixel of every tile of every block.

    `table` holds a splat per row: mean x and y, inverse_a, slope, inverse_b, opacity, then any number of channels.
    Differentiable in `table` both ways: forward mode runs the tangents through the same loops, reverse mode runs the
    rounds again from the back with the transmittance saved at the start of each.
    """
    return _blend(schedule, table, lists, keep_states=False)[0]


@composite.defjvp
def _composite_jvp(schedule: Schedule, primals, tangents):
    table, lists = primals
    out, (states, done) = _blend(schedule, table, lists, keep_states=True)

    def push(table_dot):
        return jax.jvp(lambda table: _blend(schedule, table, lists, keep_states=False)[0], (table,), (table_dot,))[1]

    def pull(cotangents):
        return _pull_back(schedule, table, lists, states, done, out[1], cotangents)

    return out, _linear_map(push, pull, tangents[0], out, _first_order_only(table))
