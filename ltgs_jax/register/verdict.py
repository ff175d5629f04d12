"""What the answer is worth: its confidence, and the axis about which it may be free to turn."""

import math

import jax
import jax.numpy as jnp
from jax.lax import Precision
from jax.scipy.stats import norm
from jaxtyping import Array, Float

from .hypotheses import Problem
from .outcome import RegisterConfig
from .refine import BOUND_IN_SIGMA

# Distinction at which right and wrong consensus are even, and the slope of the logistic there (fitted, see the docs).
_EVEN, _SLOPE = 2.2, 3.0
# A right answer is within these of the truth: 5 degrees, and 5 % of the diameter, which is about twice the unit.
_ANGLE, _SHIFT = math.radians(5.0), 0.1
# Share of the inliers, farthest from the axis, that may be there by chance.
_CHANCE_SHARE = 0.1
_LIKELY = 0.5
_TRIMS = 4


def _norm_under(limit: float, covariance: Float[Array, "3 3"]) -> Float[Array, ""]:
    """Probability that a Gaussian vector is shorter than `limit`.

    By a gamma with the moments of its square, whose cube root is nearly normal (Wilson and Hilferty 1931).
    """
    mean = jnp.trace(covariance)
    variance = 2 * jnp.sum(covariance * covariance)
    tiny = jnp.finfo(covariance.dtype).tiny ** 0.5
    certain = (mean <= tiny) | (variance <= tiny)
    mean, variance = jnp.where(certain, 1, mean), jnp.where(certain, 1, variance)
    ninth = variance / (9 * mean * mean)
    return jnp.where(certain, 1, norm.cdf((jnp.cbrt(limit**2 / mean) - 1 + ninth) / jnp.sqrt(ninth)))


def confidence(
    distinction: Float[Array, ""], covariance: Float[Array, "6 6"], axis: Float[Array, "3"]
) -> Float[Array, ""]:
    """Probability of a right answer: that the consensus is not chance's, and that its noise leaves it near the truth.

    `covariance` of the tangent at the centre, in units of the object's size; a free turn about `axis` is no error.
    """
    keep = jnp.eye(3, dtype=covariance.dtype) - jnp.outer(axis, axis)
    turn = jnp.matmul(keep, jnp.matmul(covariance[3:, 3:], keep, precision=Precision.HIGHEST))
    near = _norm_under(_ANGLE, turn) * _norm_under(_SHIFT, covariance[:3, :3])
    return jax.nn.sigmoid(_SLOPE * (distinction - _EVEN)) * near


def free_axis(problem: Problem, inlier: Float[Array, " n"], config: RegisterConfig) -> Float[Array, "3"]:
    """Unit axis, in the frame of `src`, about which the inliers do not fix the rotation; zero where they do.

    They do not when they lie so near one line that noise, or the few inliers that chance adds, make the turn.
    `inlier` weights in [0, 1].
    """
    tiny = jnp.finfo(inlier.dtype).tiny
    allowed = jnp.ceil(_CHANCE_SHARE * jnp.sum(inlier))
    # Enough of them, each weighing at least `_LIKELY`, to reach what is allowed.
    most = (_CHANCE_SHARE * inlier.size + 1) / _LIKELY + 1

    def spread(trusted):
        total = jnp.maximum(jnp.sum(trusted), tiny)
        mean = jnp.sum(trusted[:, None] * problem.src, axis=0) / total
        centred = problem.src - mean
        scatter = jnp.einsum("n,ni,nj->ij", trusted, centred, centred, precision=Precision.HIGHEST) / total
        values, vectors = jnp.linalg.eigh(scatter)
        along = jnp.matmul(centred, vectors[:, 2], precision=Precision.HIGHEST)
        return values, vectors[:, 2], jnp.sum(centred * centred, axis=1) - along**2

    def trim(_, trusted):
        across = jnp.where(inlier > _LIKELY, spread(trusted)[2], -jnp.inf)
        farthest, index = jax.lax.top_k(across, min(math.ceil(most), across.size))
        dropped = jnp.sum(jnp.cumsum(inlier[index]) <= allowed)
        return jnp.where(across > farthest[jnp.minimum(dropped, index.size - 1)], 0, inlier)

    values, axis, _ = spread(jax.lax.fori_loop(0, _TRIMS, trim, inlier))
    sigma = problem.bound / BOUND_IN_SIGMA
    free = values[0] + values[1] < jnp.maximum(config.ambiguous_ratio * values[2], (2 * sigma) ** 2)
    return jnp.where(free, axis, 0)
