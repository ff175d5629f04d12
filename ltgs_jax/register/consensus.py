"""The motion that most correspondences agree on, over a range of noise bounds, against what chance can do."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.custom_batching import sequential_vmap
from jax.lax import Precision
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from ltgs_jax.geometry import SE3

from .hypotheses import Problem, score, search
from .noise import LEVELS
from .outcome import Effort, RegisterConfig

# Bounds, in units of the given one, at which finalists are compared, the given one first.
_COMPARED = (1.0, 2.0, 4.0, 0.5, 0.25)
# Finalists that move the points by less than this many bounds (rms) are one motion, found more or less exactly.
_SAME = 4.0
# Any two correspondences that keep their distance agree on a motion, and a third agrees with them soon.
_LEAST_NULL = 2.5
# Distinction by which another bound must beat the one before: the null has its own luck.
_CHANGE = 1.0
# Share of the best distinction from which a finalist counts as a rival of the best.
_RIVAL = 0.6
# Residuals of the stated noise score 1.27 times as much at twice the bound and 0.40 times at half of it; of twice the
# noise 2.5 and 0.19 times, of half the noise 1.05 and 0.79 times. Between them, by geometric means:
_WIDENS, _NARROWS = 1.8, 0.56
# Spread of the best chance score over permutations: a share of it and a part of a vote (measured, N = 20 to 1000).
_NULL_SPREAD = (0.09, 0.1)


class Consensus(eqx.Module):
    """The motion that stands out most from chance, and the noise bound at which it does.

    `motions` its best versions at the bound and at the narrower `LEVELS` of it; `distinction` how far its score lies
    above the best one of the same search on permuted correspondences, in units of the latter's spread; `null` the
    latter; `plain` whether it stands out at the given bound and its scores at others are those of the stated noise.
    """

    motions: SE3
    plain: Bool[Array, ""]
    distinction: Float[Array, ""]
    null: Float[Array, ""]
    bound: Float[Array, ""]


def permuted(problem: Problem, key: PRNGKeyArray) -> Problem:
    """The same points with the usable `dst` dealt out at random: no motion is right, every shape is kept."""
    usable = problem.weights > 0
    priority = jax.random.uniform(key, usable.shape, problem.src.dtype)
    dealt = jnp.argsort(jnp.where(usable, priority, 2))
    places = jnp.argsort(~usable, stable=True)
    return eqx.tree_at(lambda p: p.dst, problem, problem.dst.at[places].set(problem.dst[dealt]))


def distinction(score: Float[Array, "..."], null: Float[Array, "..."], unit: Float[Array, ""]) -> Float[Array, "..."]:
    """Score above the null in units of the null's spread; `unit` the weight of one vote."""
    share, part = _NULL_SPREAD
    return (score - null) / (share * null + part * unit)


def vote(problem: Problem) -> Float[Array, ""]:
    """Weight of the most trusted correspondence: the unit of scores."""
    most = jnp.max(problem.weights)
    return jnp.where(most > 0, most, 1)


def displacements(motions: SE3, problem: Problem) -> Float[Array, "f f"]:
    """Root mean square distance between the usable points as moved by each two motions."""
    usable = (problem.weights > 0).astype(problem.src.dtype)
    total = jnp.maximum(jnp.sum(usable), 1)
    mean = jnp.sum(usable[:, None] * problem.src, axis=0) / total
    centred = usable[:, None] * (problem.src - mean)
    spread = jnp.matmul(centred.T, centred, precision=Precision.HIGHEST) / total
    rotmats = motions.rotmat()
    moved = motions.xyz + jnp.einsum("fij,j->fi", rotmats, mean, precision=Precision.HIGHEST)
    turn = rotmats[:, None] - rotmats[None]
    squared = jnp.einsum("abij,jk,abik->ab", turn, spread, turn, precision=Precision.HIGHEST)
    return jnp.sqrt(jnp.maximum(squared + jnp.sum((moved[:, None] - moved[None]) ** 2, axis=-1), 0))


def _scores(motions: SE3, problem: Problem, factors: tuple[float, ...]) -> Float[Array, "b f"]:
    """Scores of every motion at several factors of the bound."""
    bounds = problem.bound * jnp.asarray(factors, problem.src.dtype)
    return jax.lax.map(lambda bound: score(motions, problem.at_bound(bound)), bounds)


def _attempt(problem: Problem, key: PRNGKeyArray, effort: Effort, config: RegisterConfig) -> Consensus:
    """Search, on the correspondences and on permuted ones, by one program."""
    start = jnp.asarray(effort.bound_factors, problem.src.dtype)
    both = jax.tree.map(lambda a, b: jnp.stack([a, b]), problem, permuted(problem, key))
    every = jax.tree.map(lambda leaf: jnp.repeat(leaf, start.size, axis=0), both)
    every = every.at_bound(every.bound * jnp.tile(start, 2))
    found = jax.lax.map(lambda pair: search(pair, effort, config).motion, every)
    found = jax.tree.map(lambda leaf: leaf.reshape(2, -1, leaf.shape[-1]), found)
    scores = jax.lax.map(lambda pair: _scores(*pair, _COMPARED), (found, both))
    null = jnp.maximum(jnp.max(scores[1], axis=1), _LEAST_NULL * vote(problem))
    above = distinction(scores[0], null[:, None], vote(problem))
    motions = found[0]
    # The caller had a reason for the given bound.
    handicap = jnp.full(len(_COMPARED), _CHANGE).at[0].set(0)[:, None]
    heard = jnp.max(above, axis=1, keepdims=True)
    standing = jnp.max(above - handicap, axis=0)
    # Which of two motions it is, all bounds say at which anything stands out; where it is, the exact pairs.
    rivals = standing >= _RIVAL * jnp.max(standing)
    votes = jnp.sum(jnp.where(heard >= _RIVAL * jnp.max(heard), above, 0), axis=0)
    leader = jnp.argmax(jnp.where(rivals, votes, -jnp.inf))
    near = displacements(motions, problem)[leader] < _SAME * problem.bound
    same = near.at[leader].set(True)
    clear = jnp.max(jnp.where(same, above, -jnp.inf), axis=1)
    level = jnp.where(clear[0] >= config.settle, 0, jnp.argmax(clear - handicap[:, 0]))
    bound = problem.bound * jnp.asarray(_COMPARED, problem.src.dtype)[level]
    exact = jnp.argmax(jnp.where(same, _scores(motions, problem.at_bound(bound), LEVELS), -jnp.inf), axis=1)
    at_given, at_twice, _, at_half, _ = scores[0][:, exact[0]]
    stated = (at_twice < _WIDENS * at_given) & (at_half < _NARROWS * at_given)
    plain = stated & (clear[0] >= config.settle)
    return Consensus(motions[exact], plain, (clear - handicap[:, 0])[level], null[level], bound)


def _sweep(first: Consensus, problem: Problem, key: PRNGKeyArray, config: RegisterConfig) -> Consensus:
    """Where the first is not plain, a search over bounds at once; then thorough ones in turn, until one stands out."""
    pooled = jax.lax.cond(first.plain, lambda: first, lambda: _attempt(problem, key, config.quick, config))
    factors = jnp.asarray(config.bound_factors, problem.src.dtype)

    def unsettled(state):
        step, best = state
        return (step < factors.size) & (best.distinction < config.settle)

    def attempt(state):
        step, best = state
        new = _attempt(problem.at_bound(problem.bound * factors[step]), key, config.thorough, config)
        better = (step == 0) | (new.distinction > best.distinction + _CHANGE)
        return step + 1, jax.tree.map(lambda a, b: jnp.where(better, a, b), new, best)

    return jax.lax.while_loop(unsettled, attempt, (jnp.asarray(0), pooled))[1]


@functools.partial(jax.custom_jvp, nondiff_argnums=(3,))
def _sweep_where_needed(first: Consensus, problem: Problem, key: PRNGKeyArray, config: RegisterConfig) -> Consensus:
    """`_sweep`; of a batch only the problems that need it, one after the other."""
    return sequential_vmap(lambda *args: _sweep(*args, config))(first, problem, key)


@_sweep_where_needed.defjvp
def _no_tangent(config, primals, tangents):
    del tangents
    found = _sweep_where_needed(*primals, config)
    return found, jax.tree.map(_zero_tangent, found)


def _zero_tangent(leaf):
    if jnp.issubdtype(leaf.dtype, jnp.inexact):
        return jnp.zeros_like(leaf)
    return jnp.zeros(leaf.shape, jax.dtypes.float0)


def find_consensus(problem: Problem, key: PRNGKeyArray, config: RegisterConfig) -> Consensus:
    """Consensus by a first search at the given bound; where that is not plain, by a quick one at several bounds.

    Where that does not stand out either, by thorough ones at factors of the bound, up to the distinction `settle`.
    """
    first = _attempt(problem, key, config.first, config)
    return _sweep_where_needed(first, problem, key, config)


def find_second(problem: Problem, config: RegisterConfig) -> tuple[SE3, Float[Array, ""]]:
    """The motion that most of the problem's weights agree on, by the first search without a null, and its score."""
    best = search(problem, config.first, config).top(1)
    return best.motion[0], best.score[0]
