"""Could chance have made this consensus? The score against that of permuted correspondences."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from .hypotheses import Problem, polish, search
from .outcome import RegisterConfig

# Score above the null at which right and wrong are even, and the width of the logistic, in correspondences.
_EVEN_MARGIN = 0.5
_MARGIN_WIDTH = 0.15


def permuted(problem: Problem, key: PRNGKeyArray) -> Problem:
    """The same points with the usable `dst` dealt out at random: no motion is right, every shape is kept."""
    usable = problem.weights > 0
    priority = jax.random.uniform(key, usable.shape)
    dealt = jnp.argsort(jnp.where(usable, priority, 2))
    places = jnp.argsort(~usable, stable=True)
    return eqx.tree_at(lambda p: p.dst, problem, problem.dst.at[places].set(problem.dst[dealt]))


def null_score(problem: Problem, config: RegisterConfig, key: PRNGKeyArray) -> Float[Array, ""]:
    """Best score that the same search reaches on permuted correspondences."""
    null = permuted(problem, key)
    return jnp.max(polish(search(null, config), null, config).score)


def confidence_against(score: Float[Array, ""], null: Float[Array, ""]) -> Float[Array, ""]:
    """Probability that a motion with this score is right, given what chance reached."""
    return jax.nn.sigmoid((score - null - _EVEN_MARGIN) / _MARGIN_WIDTH)
