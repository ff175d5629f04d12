"""The motion that most correspondences agree on, over a range of noise bounds, against what chance can do."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from ltgs_jax.geometry import SE3

from .hypotheses import Hypotheses, Problem, polish, rescore, score, search
from .outcome import RegisterConfig

# Bounds, in units of the one searched at, at which finalists are compared: of two motions whose exact pairs tie, the
# one with more near pairs is the larger.
_COMPARED = (1.0, 2.0, 4.0)
# Any two correspondences that keep their distance agree on a motion, and a third agrees with them soon.
_LEAST_NULL = 2.5
# Distinction by which another bound must beat the one before: the null has its own luck.
_CHANGE = 1.0
# Share of the best distinction from which a finalist counts as a rival of the best.
_RIVAL = 0.6
# Spread of the best chance score over permutations: a share of it and a part of a vote (measured, N = 20 to 1000).
_NULL_SPREAD = (0.09, 0.1)


class Consensus(eqx.Module):
    """The best motion at the noise bound at which it stands out most from chance.

    `distinction` how far its score lies above the best one of the same search on permuted correspondences, in units of
    that score's spread; `null` the latter; `found` every hypothesis at that bound.
    """

    motion: SE3
    distinction: Float[Array, ""]
    null: Float[Array, ""]
    bound: Float[Array, ""]
    found: Hypotheses


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


def _attempt(problem: Problem, key: PRNGKeyArray, config: RegisterConfig) -> Consensus:
    """Search at one bound, on the correspondences and on permuted ones, by one program."""

    def run(pair: Problem) -> tuple[Hypotheses, SE3, Float[Array, "b s"]]:
        found = search(pair, config)
        motion = polish(found, pair, config).motion
        bounds = pair.bound * jnp.asarray(_COMPARED, pair.src.dtype)
        return found, motion, jax.lax.map(lambda bound: score(motion, pair.at_bound(bound)), bounds)

    both = jax.tree.map(lambda a, b: jnp.stack([a, b]), problem, permuted(problem, key))
    found, motions, scores = jax.lax.map(run, both)
    null = jnp.maximum(jnp.max(scores[1], axis=1), _LEAST_NULL * vote(problem))
    above = distinction(scores[0], null[:, None], vote(problem))
    rivals = above[0] >= _RIVAL * jnp.max(above[0])
    best = jnp.argmax(jnp.where(rivals, jnp.sum(above, axis=0), -jnp.inf))
    return Consensus(motions[0, best], above[0, best], null[0], problem.bound, jax.tree.map(lambda x: x[0], found))


def find_consensus(problem: Problem, key: PRNGKeyArray, config: RegisterConfig) -> Consensus:
    """Consensus at the given bound, or, where that does not stand out, at the factor of it where it does most.

    The sweep ends at the first bound with the distinction `settle`.
    """
    factors = jnp.asarray(config.bound_factors, problem.src.dtype)

    def unsettled(state):
        step, best = state
        return (step < factors.size) & ((step == 0) | (best.distinction < config.settle))

    def attempt(state):
        step, best = state
        new = _attempt(problem.at_bound(problem.bound * factors[step]), key, config)
        better = (step == 0) | (new.distinction > best.distinction + _CHANGE)
        return step + 1, jax.tree.map(lambda a, b: jnp.where(better, a, b), new, best)

    shape = jax.eval_shape(lambda: _attempt(problem, key, config))
    nothing = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shape)
    _, best = jax.lax.while_loop(unsettled, attempt, (jnp.asarray(0), nothing))
    return best


def find_second(
    consensus: Consensus, problem: Problem, remaining: Float[Array, " n"], config: RegisterConfig
) -> tuple[SE3, Float[Array, ""]]:
    """The motion that the `remaining` weights agree on most, and its score."""
    rest = Problem(problem.src, problem.dst, remaining, consensus.bound)
    return polish(rescore(consensus.found.motion, rest), rest, config).best()
