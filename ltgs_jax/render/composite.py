"""Front-to-back blending of tiles, with its pushforward and its pull-back."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jax.lax import Precision
from jaxtyping import Array, Float, Int

from .config import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_STOP
from .slots import Schedule, Slots, channel_count, round_forms


def _pixel_offsets(tile_size: int, dtype) -> tuple[np.ndarray, np.ndarray]:
    """x and y of a tile's pixel centres relative to the tile's centre, as constants of the program."""
    side = np.arange(tile_size) + 0.5 - tile_size / 2
    return np.tile(side, tile_size).astype(dtype), np.repeat(side, tile_size).astype(dtype)


def _alphas(shape: tuple[Float[Array, "t q g"], ...], tile_size: int) -> Float[Array, "t q g p"]:
    """α of every splat of a round at every pixel of its tile, 0 where skipped; splats in q groups of g."""
    p0, p1, q0, q1, q2, opacity = (form[..., None] for form in shape)
    x, y = _pixel_offsets(tile_size, opacity.dtype)
    p, q = p0 + p1 * x, q0 + q1 * x + q2 * y
    alpha = jnp.minimum(opacity * jnp.exp(-0.5 * (p * p + q * q)), ALPHA_MAX)
    return _kept(jnp.where(alpha >= ALPHA_MIN, alpha, 0))


def _kept(x: Array) -> Array:
    """A hint to keep `x` in memory instead of computing it again in every consumer."""
    return jax.lax.optimization_barrier(x)


def _dimmed(transmittance: Array, alpha: Array) -> Array:
    """Transmittance behind a splat."""
    return transmittance * (1 - alpha)


def _scanned(x: Float[Array, "t q g p"], start: Float[Array, "t p"], reverse: bool, step, unit: float):
    """Exclusive scan step(…step(start, x_0)…, x_k−1) over the splats of a round, as masked reductions.

    `unit` is the start from which a group's own steps are taken to be applied as one; an x of 0 must change nothing.
    Each element reads those before it (after it, in reverse) in its group, and the groups before: some eight reads that
    vectorise over pixels, where a true scan along a short axis does not (fact 9 of the conventions).
    """
    groups, members = x.shape[1:3]
    whole = functools.reduce(step, [x[:, :, j] for j in range(members)], jnp.asarray(unit, x.dtype))
    whole = _kept(jnp.broadcast_to(whole, (x.shape[0], groups, x.shape[3])))
    join = jnp.multiply if unit else jnp.add
    ahead = jnp.broadcast_to(start[:, None], whole.shape)
    index = jnp.arange(groups)[None, :, None]
    for j in range(groups):
        ahead = join(ahead, jnp.where(index < j if reverse else index > j, whole[:, j : j + 1], unit))
    ahead = _kept(ahead)[:, :, None]
    index = jnp.arange(members)[None, None, :, None]
    for j in range(members):
        ahead = step(ahead, jnp.where(index < j if reverse else index > j, x[:, :, j : j + 1], 0))
    return ahead


def _weights(alphas: Float[Array, "t q g p"], start: Float[Array, "t p"]) -> Float[Array, "t q g p"]:
    """Weights αT of a round that begins with transmittance `start`."""
    transmittance = _scanned(alphas, start, False, _dimmed, 1)
    return _kept(jnp.where(transmittance > TRANSMITTANCE_STOP, alphas * transmittance, 0))


def _passed(alphas: Float[Array, "t q g p"], transmittance: Float[Array, "t p"]) -> Float[Array, "t p"]:
    """Transmittance after a round; frozen by the first splat that takes it to the stop."""
    for i, j in np.ndindex(alphas.shape[1:3]):
        after = _dimmed(transmittance, alphas[:, i, j])
        transmittance = jnp.where(transmittance > TRANSMITTANCE_STOP, after, transmittance)
    return transmittance


def _blended(weights: Float[Array, "t q g p"], channel: Float[Array, "t q g"]) -> Float[Array, "t p"]:
    """Σ weight·channel over a round, unrolled so that it fuses: batched products of tiny matrices are slow on CPUs."""
    return sum(weights[:, i, j] * channel[:, i, j, None] for i, j in np.ndindex(weights.shape[1:3]))


def _flat(x: Float[Array, "t q g *rest"]) -> Float[Array, "t k *rest"]:
    """Groups of splats to one axis."""
    return x.reshape(x.shape[0], -1, *x.shape[3:])


def _blend(schedule: Schedule, table, slots: Slots, keep_states: bool):
    """Blend all blocks; with `keep_states` also the transmittance before every round and the rounds done."""
    tiles, pixels = schedule.tiles_per_block, schedule.tile_size**2
    blocks = slots.blocks
    states = jnp.ones((schedule.rounds if keep_states else 1, tiles, pixels), table.dtype)

    def block_step(states, block):
        def going(carry):
            round_index, transmittance, _, _ = carry
            return (round_index < blocks.limits[block]) & jnp.any(transmittance > TRANSMITTANCE_STOP)

        def advance(carry):
            round_index, transmittance, totals, states = carry
            place = blocks.offsets[block] + round_index
            if keep_states:
                states = jax.lax.dynamic_update_index_in_dim(states, transmittance, place, 0)
            index, centres = _at(slots, place)
            shape, channels = _kept(round_forms(table[index], centres))
            alphas = _alphas(shape, schedule.tile_size)
            weights = _weights(alphas, transmittance)
            totals = tuple(total + _blended(weights, ch) for total, ch in zip(totals, channels, strict=True))
            return round_index + 1, _passed(alphas, transmittance), totals, states

        clear = jnp.ones((tiles, pixels), table.dtype)
        nothing = (jnp.zeros_like(clear),) * channel_count(table)
        first = jnp.zeros((), jnp.int32)
        done, transmittance, totals, states = jax.lax.while_loop(going, advance, (first, clear, nothing, states))
        return states, (totals, transmittance, done)

    count = blocks.offsets.shape[0]
    states, (totals, transmittance, done) = jax.lax.scan(block_step, states, jnp.arange(count, dtype=jnp.int32))
    return (totals, transmittance), (states, done)


def _at(slots: Slots, place: Int[Array, ""]) -> tuple[Int[Array, "t k"], Float[Array, "t 2"]]:
    """Splats and tile centres of one round."""
    return tuple(jax.lax.dynamic_index_in_dim(x, place, keepdims=False) for x in (slots.index, slots.centres))


def _pull_back(schedule: Schedule, table, slots: Slots, states, done, final, cotangents):
    """Gradient of the table: blocks again, their rounds from back to front.

    With e_k = c_k·∂L/∂C and S_k = Σ_{j>k} w_j e_j + T_end ∂L/∂T_end, ∂L/∂α_k = T_k e_k − S_k / (1 − α_k). What reaches
    p and q are the moments of ∂L/∂σ = −α ∂L/∂α over the tile's pixels, a product with one fixed matrix.
    """
    totals_ct, transmittance_ct = cotangents
    x, y = _pixel_offsets(schedule.tile_size, table.dtype)
    # Two columns of zeros: a product 8 wide takes a quarter of the time of one 6 wide on CPUs.
    monomials = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y, 0 * x, 0 * x], axis=-1)

    def block_step(gradient, block):
        cotangent = [total_ct[block] for total_ct in totals_ct]
        stacked_ct = jnp.stack(cotangent, axis=1)

        def retreat(carry):
            round_index, behind, gradient = carry
            round_index = round_index - 1
            place = slots.blocks.offsets[block] + round_index
            index, centres = _at(slots, place)
            forms, pull = jax.vjp(lambda rows: round_forms(rows, centres), table[index])
            shape, channels = _kept(forms)
            alphas = _alphas(shape, schedule.tile_size)
            weights = _weights(alphas, jax.lax.dynamic_index_in_dim(states, place, keepdims=False))
            worth = sum(ch[..., None] * ct[:, None, None] for ch, ct in zip(channels, cotangent, strict=True))
            worth = _kept(weights * worth)
            remaining = _scanned(worth, behind, True, jnp.add, 0)
            active = (weights > 0) & (alphas < ALPHA_MAX)
            pulls = _kept(jnp.where(active, remaining * alphas / (1 - alphas) - worth, 0))
            behind = behind + sum(worth[:, i, j] for i, j in np.ndindex(worth.shape[1:3]))
            channel_ct = jnp.einsum("tkp,tcp->tkc", _flat(weights), stacked_ct, precision=Precision.HIGHEST)
            moments = jnp.matmul(_flat(pulls), monomials, precision=Precision.HIGHEST)
            channel_ct = tuple(channel_ct[..., c].reshape(ch.shape) for c, ch in enumerate(channels))
            (rows_ct,) = pull((_shape_gradient(shape, moments), channel_ct))
            return round_index, behind, gradient.at[index].add(rows_ct)

        behind = final[block] * transmittance_ct[block]
        carry = jax.lax.while_loop(lambda carry: carry[0] > 0, retreat, (done[block], behind, gradient))
        return carry[2], None

    return jax.lax.scan(block_step, jnp.zeros_like(table), jnp.arange(done.shape[0], dtype=jnp.int32))[0]


def _shape_gradient(
    shape: tuple[Float[Array, "t q g"], ...], moments: Float[Array, "t k 8"]
) -> tuple[Float[Array, "t q g"], ...]:
    """From the moments of ∂L/∂σ, σ = ½(p² + q²), to p0, p1, q0, q1, q2 and the opacity."""
    p0, p1, q0, q1, q2, opacity = shape
    one, x, y, xx, xy, yy = (moments[..., j].reshape(p0.shape) for j in range(6))
    # α = opacity·exp(−σ): ∂L/∂opacity = Σ ∂L/∂α·α / opacity; an empty slot has opacity 0 and no moments.
    opacity_ct = -one / jnp.maximum(opacity, jnp.finfo(opacity.dtype).tiny)
    return (
        p0 * one + p1 * x,
        p0 * x + p1 * xx,
        q0 * one + q1 * x + q2 * y,
        q0 * x + q1 * xx + q2 * xy,
        q0 * y + q1 * xy + q2 * yy,
        opacity_ct,
    )


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
    right_side = (tangent, jax.tree.map(lambda leaf: jnp.broadcast_to(zero, leaf.shape), like))
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
    schedule: Schedule, table: Float[Array, "m f"], slots: Slots
) -> tuple[tuple[Float[Array, "b t p"], ...], Float[Array, "b t p"]]:
    """Blended channels, one array each, and final transmittance of every pixel of every tile of every block.

    Rows of the `table` of splats are gathered round by round, and their gradients scattered likewise: laid out for all
    rounds at once they would be most of a program's memory.

    Differentiable in `table` both ways: forward mode runs the tangents through the same loops, reverse mode runs the
    rounds again from the back, with the transmittance saved at the start of each.
    """
    return _blend(schedule, table, slots, keep_states=False)[0]


@composite.defjvp
def _composite_jvp(schedule: Schedule, primals, tangents):
    table, slots = primals
    out, (states, done) = _blend(schedule, table, slots, keep_states=True)

    def push(table_dot):
        return jax.jvp(lambda table: _blend(schedule, table, slots, keep_states=False)[0], (table,), (table_dot,))[1]

    def pull(cotangents):
        return _pull_back(schedule, table, slots, states, done, out[1], cotangents)

    return out, _linear_map(push, pull, tangents[0], out, _first_order_only(table))
