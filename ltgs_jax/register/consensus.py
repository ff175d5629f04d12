"""The motion that most correspondences agree on, over a range of noise bounds, against what chance can do."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from ltgs_jax.geometry import SE3

from .hypotheses import Hypotheses, Problem, polish, rescore, search
from .outcome import RegisterConfig

# Score above the null at which right and wrong are even, and the width of the logistic, in correspondences.
_EVEN_MARGIN = 0.5
_MARGIN_WIDTH = 0.15


class Consensus(eqx.Module):
    """The best motion at the noise bound at which it stands out most from chance.

    `null` is the best score of the same search on permuted correspondences; `found` every hypothesis at that bound.
    """

    motion: SE3
    score: Float[Array, ""]
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


def confidence_against(score: Float[Array, ""], null: Float[Array, ""], unit: Float[Array, ""]) -> Float[Array, ""]:
    """Probability that a motion with this score is right, given what chance reached; `unit` the weight of one vote."""
    return jax.nn.sigmoid(((score - null) / unit - _EVEN_MARGIN) / _MARGIN_WIDTH)


def vote(problem: Problem) -> Float[Array, ""]:
    """Weight of the most trusted correspondence: the unit of scores."""
    return jnp.maximum(jnp.max(problem.weights), jnp.finfo(problem.weights.dtype).tiny)


def _attempt(problem: Problem, key: PRNGKeyArray, config: RegisterConfig) -> Consensus:
    """Search at one bound, on the correspondences and on permuted ones, by one program."""

    def run(pair: Problem) -> tuple[Hypotheses, Hypotheses]:
        found = search(pair, config)
        return found, polish(found, pair, config)

    both = jax.tree.map(lambda a, b: jnp.stack([a, b]), problem, permuted(problem, key))
    found, refined = jax.lax.map(run, both)
    motion, score = jax.tree.map(lambda leaf: leaf[0], refined).best()
    null = jnp.max(refined.score[1])
    return Consensus(motion, score, null, problem.bound, jax.tree.map(lambda leaf: leaf[0], found))


def find_consensus(problem: Problem, key: PRNGKeyArray, config: RegisterConfig) -> Consensus:
    """Consensus at the given bound, or, where that does not stand out, at the factors of it that do.

    The sweep ends at the first bound with the confidence `settle`; where none has it, the most confident one wins.
    """
    factors = jnp.asarray(config.bound_factors, problem.src.dtype)
    unit = vote(problem)

    def margin(consensus: Consensus) -> Float[Array, ""]:
        return confidence_against(consensus.score, consensus.null, unit)

    def unsettled(state):
        step, best = state
        return (step < factors.size) & (margin(best) < config.settle)

    def attempt(state):
        step, best = state
        new = _attempt(problem.at_bound(problem.bound * factors[step]), key, config)
        better = (step == 0) | (margin(new) > margin(best))
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
