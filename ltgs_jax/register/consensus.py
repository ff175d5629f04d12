"""The motion that most correspondences agree on, over a range of noise bounds, against what chance can do."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.custom_batching import sequential_vmap
from jax.lax import Precision
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from ltgs_jax.geometry import SE3

from .hypotheses import Hypotheses, Problem, score, search
from .outcome import Effort, RegisterConfig

# Bounds, in units of the one searched at, at which finalists are compared: of two motions whose exact pairs tie, the
# one with more near pairs is the larger.
_COMPARED = (1.0, 2.0, 4.0)
# Finalists that move the points by less than this many bounds (rms) are one motion, found more or less exactly.
_SAME = 4.0
# Any two correspondences that keep their distance agree on a motion, and a third agrees with them soon.
_LEAST_NULL = 2.5
# Distinction by which another bound must beat the one before: the null has its own luck.
_CHANGE = 1.0
# Share of the best distinction from which a finalist counts as a rival of the best.
_RIVAL = 0.6
# Spread of the best chance score over permutations: a share of it and a part of a vote (measured, N = 20 to 1000).
_NULL_SPREAD = (0.09, 0.1)


class Consensus(eqx.Module):
    """The best motion at the noise bound at which it stands out most from chance, in several versions.

    `motions` [f] what the search ended with, of which `same` are versions of the best, its score first among them;
    `distinction` how far that score lies above the best one of the same search on permuted correspondences, in units of
    the latter's spread; `null` the latter.
    """

    motions: SE3
    same: Bool[Array, " f"]
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


def _attempt(problem: Problem, key: PRNGKeyArray, effort: Effort, config: RegisterConfig) -> Consensus:
    """Search at one bound, on the correspondences and on permuted ones, by one program."""

    def run(pair: Problem) -> tuple[Hypotheses, Float[Array, "b f"]]:
        found = search(pair, effort, config)
        bounds = pair.bound * jnp.asarray(_COMPARED, pair.src.dtype)
        return found, jax.lax.map(lambda bound: score(found.motion, pair.at_bound(bound)), bounds)

    both = jax.tree.map(lambda a, b: jnp.stack([a, b]), problem, permuted(problem, key))
    found, scores = jax.lax.map(run, both)
    null = jnp.maximum(jnp.max(scores[1], axis=1), _LEAST_NULL * vote(problem))
    above = distinction(scores[0], null[:, None], vote(problem))
    motions = jax.tree.map(lambda leaf: leaf[0], found.motion)
    near = displacements(motions, problem) < _SAME * problem.bound
    # Where a motion is, its exact pairs say; which of two motions it is, all near pairs of all its versions.
    rivals = above[0] >= _RIVAL * jnp.max(above[0])
    leader = jnp.argmax(jnp.where(rivals, jnp.sum(above, axis=0), -jnp.inf))
    same = near[leader].at[leader].set(True)
    standing = jnp.where(same, above[0], -jnp.inf)
    # The best versions first, as many as every effort has.
    kept, order = jax.lax.top_k(standing, min(config.versions, standing.size))
    return Consensus(motions[order], jnp.isfinite(kept), kept[0], null[0], problem.bound)


def _sweep(first: Consensus, problem: Problem, key: PRNGKeyArray, config: RegisterConfig) -> Consensus:
    """Thorough searches at the factors of the noise bound in turn, until one stands out."""
    factors = jnp.asarray(config.bound_factors, problem.src.dtype)

    def unsettled(state):
        step, best = state
        return (step < factors.size) & (best.distinction < config.settle)

    def attempt(state):
        step, best = state
        new = _attempt(problem.at_bound(problem.bound * factors[step]), key, config.thorough, config)
        better = (step == 0) | (new.distinction > best.distinction + _CHANGE)
        return step + 1, jax.tree.map(lambda a, b: jnp.where(better, a, b), new, best)

    return jax.lax.while_loop(unsettled, attempt, (jnp.asarray(0), first))[1]


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
    """Consensus at the given bound by a quick search, or, where that does not stand out, by thorough ones.

    The sweep over factors of the bound ends at the first with the distinction `settle`.
    """
    first = _attempt(problem, key, config.quick, config)
    return _sweep_where_needed(first, problem, key, config)


def find_second(problem: Problem, config: RegisterConfig) -> tuple[SE3, Float[Array, ""]]:
    """The motion that most of the problem's weights agree on, by a quick search without a null, and its score."""
    best = search(problem, config.quick, config).top(1)
    return best.motion[0], best.score[0]
