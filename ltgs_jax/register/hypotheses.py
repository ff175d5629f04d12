"""Hypotheses of the motion from the spatial compatibility of pairs of correspondences."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.lax import Precision
from jaxtyping import Array, Float, Int

from ltgs_jax.geometry import SE3

from .align import align, alignment_moments, squared_residuals
from .outcome import RegisterConfig

# Two inliers' lengths differ by N(0, 2σ²); 3.37σ, the benchmark's noise bound, keeps 98 % of their pairs.
_PAIR_BOUND = 1.0
# A point joins a seed's local set when its second-order score exceeds this share of the set's best.
_LOCAL_SHARE = 0.5
# Geman-McClure weights at half the bound fall to 1/25 at the bound.
_REFINE_FACTOR = 0.5
# Columns of the compatibility matrix that are held at once; larger problems are padded to a multiple.
BLOCK = 1024


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


class Hypotheses(eqx.Module):
    """Motions with their truncated-least-squares scores, the number of correspondences in the best case."""

    motion: SE3
    score: Float[Array, " s"]

    def best(self) -> tuple[SE3, Float[Array, ""]]:
        """The motion of the highest score, and that score."""
        index = jnp.argmax(self.score)
        return self.motion[index], self.score[index]


def _lengths(a: Float[Array, "m 3"], b: Float[Array, "n 3"]) -> Float[Array, "m n"]:
    return jnp.sqrt(sum((a[:, None, k] - b[None, :, k]) ** 2 for k in range(3)))


def _compatibility(problem: Problem, rows: Int[Array, " m"], columns: Int[Array, " k"]) -> Float[Array, "m k"]:
    """How well each pair keeps its length, 1 − (Δlength / bound)² down to 0; 0 with itself and with padding."""
    a, b = problem.take(rows), problem.take(columns)
    difference = _lengths(a.src, b.src) - _lengths(a.dst, b.dst)
    kept = jnp.maximum(1 - (difference / (_PAIR_BOUND * problem.bound)) ** 2, 0)
    pair = (a.weights > 0)[:, None] & (b.weights > 0)[None, :] & (rows[:, None] != columns[None, :])
    return jnp.where(pair, kept, 0)


def _seeds_and_second_order(problem: Problem, count: int) -> tuple[Int[Array, " s"], Float[Array, "s n"]]:
    """The best connected correspondences, and their second-order compatibility C ⊙ (C·C) with all (Chen et al. 2022).

    In blocks of columns where C would not fit: memory stays at n·BLOCK, at the price of computing C twice.
    """
    size = problem.weights.size
    every = jnp.arange(size)
    if size <= BLOCK:
        compatible = _compatibility(problem, every, every)
        _, seeds = jax.lax.top_k(jnp.sum(compatible, axis=1), count)
        rows = compatible[seeds]
        return seeds, rows * jnp.matmul(rows, compatible, precision=Precision.HIGHEST)
    blocks = every.reshape(-1, BLOCK)
    degrees = jax.lax.map(lambda columns: jnp.sum(_compatibility(problem, every, columns), axis=0), blocks)
    _, seeds = jax.lax.top_k(degrees.reshape(-1), count)
    rows = _compatibility(problem, seeds, every)

    def second_order(columns):
        common = jnp.matmul(rows, _compatibility(problem, every, columns), precision=Precision.HIGHEST)
        return rows[:, columns] * common

    second = jax.lax.map(second_order, blocks)
    return seeds, jnp.moveaxis(second, 0, 1).reshape(count, size)


def _local_weights(seeds: Int[Array, " s"], second: Float[Array, "s n"]) -> Float[Array, "s n"]:
    """Weights of each seed's local consensus set: what lies above a share of its best second-order score."""
    best = jnp.max(second, axis=1, keepdims=True)
    local = jnp.maximum(second - _LOCAL_SHARE * best, 0)
    strongest = jnp.maximum(jnp.max(local, axis=1), jnp.finfo(local.dtype).tiny)
    return local.at[jnp.arange(seeds.size), seeds].set(strongest)


def score(motion: SE3, problem: Problem) -> Float[Array, " s"]:
    """Truncated least squares as a count, Σ w·max(1 − r²/bound², 0), of each motion."""
    squared = squared_residuals(motion.rotmat(), motion.xyz, problem.src, problem.dst)
    return jnp.sum(problem.weights * jnp.maximum(1 - squared / problem.bound**2, 0), axis=1)


def reweighted(motion: SE3, problem: Problem, moments: Float[Array, "n 16"], factor) -> SE3:
    """One Geman-McClure step of every motion at `factor` times the bound."""
    squared = squared_residuals(motion.rotmat(), motion.xyz, problem.src, problem.dst)
    scale = (factor * problem.bound) ** 2
    return SE3(*align(problem.weights * (scale / (scale + squared)) ** 2, moments))


def rescore(motion: SE3, problem: Problem) -> Hypotheses:
    """Motions with their scores on a weighting of the correspondences."""
    return Hypotheses(motion, score(motion, problem))


def search(problem: Problem, config: RegisterConfig) -> Hypotheses:
    """One annealed hypothesis around each of the best connected correspondences."""
    seeds, second = _seeds_and_second_order(problem, min(config.seeds, problem.weights.size))
    moments = alignment_moments(problem.src, problem.dst)
    quats, xyz = align(_local_weights(seeds, second), moments)

    def step(motion, factor):
        return reweighted(motion, problem, moments, factor), None

    factors = jnp.asarray(config.anneal, problem.src.dtype)
    motion, _ = jax.lax.scan(step, SE3(quats, xyz), factors)
    return rescore(motion, problem)


def polish(hypotheses: Hypotheses, problem: Problem, config: RegisterConfig) -> Hypotheses:
    """The best few, each refined at the noise bound."""
    count = min(config.finalists, hypotheses.score.size)
    _, index = jax.lax.top_k(hypotheses.score, count)
    moments = alignment_moments(problem.src, problem.dst)

    motion = jax.lax.fori_loop(
        0,
        config.refine_steps,
        lambda _, motion: reweighted(motion, problem, moments, _REFINE_FACTOR),
        hypotheses.motion[index],
    )
    return rescore(motion, problem)
