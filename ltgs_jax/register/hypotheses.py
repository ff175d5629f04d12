"""Hypotheses of the motion from the spatial compatibility of pairs of correspondences."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.lax import Precision
from jaxtyping import Array, Float

from ltgs_jax.geometry import SE3, rotmat_from_quat

from .align import align, alignment_moments, squared_residuals
from .outcome import RegisterConfig

# Two inliers' lengths differ by N(0, 2σ²); 3.37σ, the benchmark's noise bound, keeps 98 % of their pairs.
_PAIR_BOUND = 1.0
# A point joins a seed's local set when its second-order score exceeds this share of the set's best.
_LOCAL_SHARE = 0.5


class Problem(eqx.Module):
    """Centred correspondences in units of their own size; `weights` 0 where padding or unusable."""

    src: Float[Array, "n 3"]
    dst: Float[Array, "n 3"]
    weights: Float[Array, " n"]
    bound: Float[Array, ""]


class Hypotheses(eqx.Module):
    """Motions with their truncated-least-squares scores, the number of correspondences in the best case."""

    motion: SE3
    score: Float[Array, " s"]

    def take(self, index) -> "Hypotheses":
        """Those at `index`."""
        return jax.tree.map(lambda leaf: leaf[index], self)


def _lengths(points: Float[Array, "n 3"]) -> Float[Array, "n n"]:
    differences = [points[:, None, k] - points[None, :, k] for k in range(3)]
    return jnp.sqrt(sum(d * d for d in differences))


def compatibility(problem: Problem) -> Float[Array, "n n"]:
    """How well each pair keeps its length, 1 − (Δlength / bound)² down to 0; 0 on the diagonal and for padding."""
    difference = _lengths(problem.src) - _lengths(problem.dst)
    kept = jnp.maximum(1 - (difference / (_PAIR_BOUND * problem.bound)) ** 2, 0)
    usable = problem.weights > 0
    pair = usable[:, None] & usable[None, :] & ~jnp.eye(usable.size, dtype=bool)
    return jnp.where(pair, kept, 0)


def _local_weights(compatible: Float[Array, "n n"], seeds) -> Float[Array, "s n"]:
    """Weights of each seed's local consensus set: second-order compatibility (SC²-PCR, Chen et al. 2022)."""
    rows = compatible[seeds]
    second = rows * jnp.matmul(rows, compatible, precision=Precision.HIGHEST)
    best = jnp.max(second, axis=1, keepdims=True)
    local = jnp.maximum(second - _LOCAL_SHARE * best, 0)
    strongest = jnp.maximum(jnp.max(local, axis=1), jnp.finfo(local.dtype).tiny)
    return local.at[jnp.arange(seeds.size), seeds].set(strongest)


def _score(squared: Float[Array, "s n"], problem: Problem) -> Float[Array, " s"]:
    return jnp.sum(problem.weights * jnp.maximum(1 - squared / problem.bound**2, 0), axis=1)


def reweighted(
    hypotheses: SE3, problem: Problem, moments: Float[Array, "n 16"], factor: float
) -> tuple[SE3, Float[Array, "s n"]]:
    """One Geman-McClure step at `factor` times the bound; the squared residuals are those after the step."""
    squared = squared_residuals(hypotheses.rotmat(), hypotheses.xyz, problem.src, problem.dst)
    scale = (factor * problem.bound) ** 2
    quats, xyz = align(problem.weights * (scale / (scale + squared)) ** 2, moments)
    return SE3(quats, xyz), squared_residuals(rotmat_from_quat(quats), xyz, problem.src, problem.dst)


def search(problem: Problem, config: RegisterConfig) -> Hypotheses:
    """One annealed hypothesis around each of the best connected correspondences."""
    compatible = compatibility(problem)
    count = min(config.seeds, problem.weights.size)
    _, seeds = jax.lax.top_k(jnp.sum(compatible, axis=1), count)
    moments = alignment_moments(problem.src, problem.dst)
    quats, xyz = align(_local_weights(compatible, seeds), moments)
    motion = SE3(quats, xyz)
    squared = jnp.zeros((count, problem.weights.size), problem.src.dtype)
    for factor in config.anneal:
        motion, squared = reweighted(motion, problem, moments, factor)
    return Hypotheses(motion, _score(squared, problem))


def polish(hypotheses: Hypotheses, problem: Problem, config: RegisterConfig) -> Hypotheses:
    """The best few, each refined at the noise bound."""
    count = min(config.finalists, hypotheses.score.size)
    _, index = jax.lax.top_k(hypotheses.score, count)
    moments = alignment_moments(problem.src, problem.dst)

    def step(motion, _):
        motion, _ = reweighted(motion, problem, moments, 0.5)
        return motion, None

    motion, _ = jax.lax.scan(step, hypotheses.motion[index], None, length=config.refine_steps)
    squared = squared_residuals(motion.rotmat(), motion.xyz, problem.src, problem.dst)
    return Hypotheses(motion, _score(squared, problem))


def rescore(hypotheses: Hypotheses, problem: Problem) -> Hypotheses:
    """The same motions scored on another weighting of the correspondences."""
    motion = hypotheses.motion
    squared = squared_residuals(motion.rotmat(), motion.xyz, problem.src, problem.dst)
    return Hypotheses(motion, _score(squared, problem))
