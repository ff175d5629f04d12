"""Scale between two point sets with mostly wrong correspondences."""

import jax
import jax.numpy as jnp
from jax.lax import Precision
from jaxtyping import Array, Float

from ltgs_jax.geometry import SE3

from .hypotheses import Problem

# Bins of the vote: factors of 1/16 to 16 in steps of 2 %.
_LOG_RANGE, _BINS = 2.7725887, 280
# Correspondences whose pairs vote; more would only sharpen a peak that is refined later.
_VOTERS = 1024


def vote_scale(problem: Problem) -> Float[Array, ""]:
    """Scale that most pairs of correspondences agree on: the mode of log |Δdst| / |Δsrc|, smoothed over three bins.

    A pair counts by its length in units of the noise bound, which is how well it knows its ratio.
    """
    count = problem.weights.size
    voters = problem.take(jnp.arange(0, count, max(1, count // _VOTERS)))

    def lengths(points):
        return jnp.sqrt(sum((points[:, None, k] - points[None, :, k]) ** 2 for k in range(3)))

    a, b = lengths(voters.src), lengths(voters.dst)
    usable = voters.weights > 0
    long = (jnp.minimum(a, b) > problem.bound) & usable[:, None] & usable[None, :]
    ratio = jnp.where(long, jnp.log(jnp.where(long, b, 1)) - jnp.log(jnp.where(long, a, 1)), 2 * _LOG_RANGE)
    edges = jnp.floor((ratio + _LOG_RANGE) * (_BINS / (2 * _LOG_RANGE))).astype(jnp.int32)
    votes = jnp.where(long, jnp.minimum(a, b), 0)
    histogram = jnp.zeros(_BINS, a.dtype).at[edges.ravel()].add(votes.ravel(), mode="drop")
    smooth = histogram + 0.5 * (jnp.roll(histogram, 1) + jnp.roll(histogram, -1))
    mode = jnp.argmax(smooth).astype(a.dtype)
    return jnp.exp((mode + 0.5) * (2 * _LOG_RANGE / _BINS) - _LOG_RANGE)


def fitted_scale(motion: SE3, problem: Problem, inlier: Float[Array, " n"]) -> Float[Array, ""]:
    """Least-squares factor of `src` at a given rotation (Umeyama 1991), noise on `dst` alone; 1 without spread."""
    total = jnp.maximum(jnp.sum(inlier), jnp.finfo(inlier.dtype).tiny)

    def centred(points):
        return points - jnp.sum(inlier[:, None] * points, axis=0) / total

    src, dst = centred(problem.src), centred(problem.dst)
    turned = jnp.matmul(src, motion.rotmat().T, precision=Precision.HIGHEST)
    square = jnp.sum(inlier[:, None] * src * src)
    known = square > 0
    scale = jnp.sum(inlier[:, None] * turned * dst) / jnp.where(known, square, 1)
    return jnp.where(known & (scale > 0), scale, 1)


def refine_scale(motion: SE3, problem: Problem, fit, rounds: int = 4) -> tuple[SE3, Float[Array, ""]]:
    """Alternate the scale and the motion; `fit(motion, problem)` gives the motion and the inlier weights.

    Returns the motion and the factor of `src` beyond what `problem` has.
    """

    def step(_, state):
        motion, factor = state
        scaled = Problem(problem.src * factor, problem.dst, problem.weights, problem.bound)
        motion, inlier = fit(motion, scaled)
        return motion, factor * fitted_scale(motion, scaled, inlier)

    return jax.lax.fori_loop(0, rounds, step, (motion, jnp.ones((), problem.src.dtype)))
