"""Hypotheses of the motion from the spatial compatibility of pairs of correspondences."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.lax import Precision
from jaxtyping import Array, Float, Int

from ltgs_jax.geometry import SE3

from .align import align, alignment_moments, squared_residuals
from .outcome import Effort, RegisterConfig

# A point joins a seed's local set when its second-order score exceeds this share of the set's best.
_LOCAL_SHARE = 0.5
# Geman-McClure weights at half the bound fall to 1/25 at the bound.
_REFINE_FACTOR = 0.5
# Columns of the compatibility matrix that are held at once; larger problems are padded to a multiple.
BLOCK = 1024
# Most correspondences of which pairs are seeds too: beyond it the best pairs are too few of all.
_PAIRED = 256


class Problem(eqx.Module):
    """Centred correspondences in units of their own size; `weights` 0 where padding or unusable."""

    src: Float[Array, "n 3"]
    dst: Float[Array, "n 3"]
    weights: Float[Array, " n"]
    bound: Float[Array, ""]

    def take(self, index) -> "Problem":
        """The correspondences at `index`."""
        return Problem(self.src[index], self.dst[index], self.weights[index], self.bound)

    def at_bound(self, bound) -> "Problem":
        """The same correspondences under another noise bound."""
        return Problem(self.src, self.dst, self.weights, bound)

    def weighed(self, weights) -> "Problem":
        """The same correspondences under other weights."""
        return Problem(self.src, self.dst, weights, self.bound)


class Hypotheses(eqx.Module):
    """Motions with their truncated-least-squares scores, the number of correspondences in the best case."""

    motion: SE3
    score: Float[Array, " s"]

    def top(self, count: int) -> "Hypotheses":
        """The best few, best first."""
        scores, index = jax.lax.top_k(self.score, min(count, self.score.size))
        return Hypotheses(self.motion[index], scores)


def _lengths(a: Float[Array, "m 3"], b: Float[Array, "n 3"]) -> Float[Array, "m n"]:
    return jnp.sqrt(sum((a[:, None, k] - b[None, :, k]) ** 2 for k in range(3)))


def _compatibility(problem: Problem, rows: Int[Array, " m"], columns: Int[Array, " k"]) -> Float[Array, "m k"]:
    """How well each pair keeps its length, 1 − (Δlength / bound)² down to 0; 0 with itself and with padding.

    Two inliers' lengths differ by N(0, 2σ²); 3.37 σ, the bound of one residual, keeps 98 % of their pairs.
    """
    a, b = problem.take(rows), problem.take(columns)
    difference = _lengths(a.src, b.src) - _lengths(a.dst, b.dst)
    kept = jnp.maximum(1 - (difference / problem.bound) ** 2, 0)
    pair = (a.weights > 0)[:, None] & (b.weights > 0)[None, :] & (rows[:, None] != columns[None, :])
    return jnp.where(pair, kept, 0)


def _around_points(seeds: Int[Array, " s"], second: Float[Array, "s n"]) -> Float[Array, "s n"]:
    """Weights of each seed's local consensus set: what lies above a share of its best second-order score."""
    best = jnp.max(second, axis=1, keepdims=True)
    local = jnp.maximum(second - _LOCAL_SHARE * best, 0)
    strongest = jnp.maximum(jnp.max(local, axis=1), jnp.finfo(local.dtype).tiny)
    return local.at[jnp.arange(seeds.size), seeds].set(strongest)


def _around_pairs(compatible: Float[Array, "n n"], second: Float[Array, "n n"], count: int) -> Float[Array, "s n"]:
    """Weights of the sets around the best pairs: both ends, and what is compatible with both."""
    size = compatible.shape[0]
    _, flat = jax.lax.top_k(jnp.triu(second).ravel(), count)
    first, last = flat // size, flat % size
    rows = jnp.arange(count)
    return (compatible[first] * compatible[last]).at[rows, first].set(1).at[rows, last].set(1)


def _local_sets(problem: Problem, effort: Effort) -> Float[Array, "s n"]:
    """Local consensus sets around the best connected points, and around the best pairs where points are few.

    By the second-order compatibility C ⊙ (C·C) of points (Chen et al. 2022). In blocks of columns where C would not
    fit: memory stays at n·BLOCK, at the price of computing C twice.
    """
    size = problem.weights.size
    count = min(effort.points, size)
    every = jnp.arange(size)
    if size <= BLOCK:
        # Else XLA computes it anew for each of its uses.
        compatible = jax.lax.optimization_barrier(_compatibility(problem, every, every))
        _, seeds = jax.lax.top_k(jnp.sum(compatible, axis=1), count)
        if size <= _PAIRED and effort.pairs:
            second = compatible * jnp.matmul(compatible, compatible, precision=Precision.HIGHEST)
            pairs = _around_pairs(compatible, second, min(effort.pairs, size * size))
            return jnp.concatenate([_around_points(seeds, second[seeds]), pairs])
        rows = compatible[seeds]
        return _around_points(seeds, rows * jnp.matmul(rows, compatible, precision=Precision.HIGHEST))
    blocks = every.reshape(-1, BLOCK)
    degrees = jax.lax.map(lambda columns: jnp.sum(_compatibility(problem, every, columns), axis=0), blocks)
    _, seeds = jax.lax.top_k(degrees.reshape(-1), count)
    rows = _compatibility(problem, seeds, every)

    def second_order(columns):
        common = jnp.matmul(rows, _compatibility(problem, every, columns), precision=Precision.HIGHEST)
        return rows[:, columns] * common

    second = jax.lax.map(second_order, blocks)
    return _around_points(seeds, jnp.moveaxis(second, 0, 1).reshape(count, size))


def score(motion: SE3, problem: Problem) -> Float[Array, " s"]:
    """Truncated least squares as a count, Σ w·max(1 − r²/bound², 0), of each motion."""
    squared = squared_residuals(motion.rotmat(), motion.xyz, problem.src, problem.dst)
    return jnp.sum(problem.weights * jnp.maximum(1 - squared / problem.bound**2, 0), axis=1)


def reweighted(motion: SE3, problem: Problem, moments: Float[Array, "n 16"], weigh: Callable) -> SE3:
    """One step of every motion: alignment by the weights that `weigh` gives to r²/bound²."""
    squared = squared_residuals(motion.rotmat(), motion.xyz, problem.src, problem.dst)
    return SE3(*align(problem.weights * weigh(squared / problem.bound**2), moments))


def geman_mcclure(factor: float | Float[Array, ""]) -> Callable:
    """Weights of r²/bound² at `factor` times the bound."""
    return lambda relative: (factor**2 / (factor**2 + relative)) ** 2


def search(problem: Problem, effort: Effort, config: RegisterConfig) -> Hypotheses:
    """One annealed hypothesis around each seed; the best are refined at the noise bound."""
    moments = alignment_moments(problem.src, problem.dst)

    def step(motion, factor):
        return reweighted(motion, problem, moments, geman_mcclure(factor)), None

    start = SE3(*align(_local_sets(problem, effort), moments))
    motion, _ = jax.lax.scan(step, start, jnp.asarray(config.anneal, problem.src.dtype))
    best = Hypotheses(motion, score(motion, problem)).top(effort.finalists)
    factors = jnp.full(config.refine_steps, _REFINE_FACTOR, problem.src.dtype)
    motion, _ = jax.lax.scan(step, best.motion, factors)
    return Hypotheses(motion, score(motion, problem))
