"""The solver behind `register`: one program for arrays of one dtype and shape."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.lax import Precision
from jaxtyping import Array, Float, PRNGKeyArray

from ltgs_jax.geometry import SE3

from .consensus import Consensus, distinction, find_consensus, find_second, vote
from .hypotheses import BLOCK, Problem
from .noise import fit_law, narrow_bound
from .outcome import RegisterConfig, Registration, Result
from .refine import (
    BOUND_IN_SIGMA,
    ResidualLaw,
    approach,
    final_solve,
    inlier_probability,
    isotropic_whitener,
    normal_equations,
    whitened_residuals,
)
from .scale import refine_scale, vote_scale
from .verdict import confidence, free_axis

# Steps from the isotropic consensus to one by covariances, which may lie far apart.
_WHITENED_STEPS = 20


def _centre(points: Float[Array, "n 3"], usable: Float[Array, " n"]) -> Float[Array, "3"]:
    return jnp.sum(usable[:, None] * points, axis=0) / jnp.maximum(jnp.sum(usable), 1)


def _prepare(src, dst, weights, noise_bound) -> tuple[Problem, Float[Array, "3"], Float[Array, "3"], Float[Array, ""]]:
    """Drop unusable rows, centre both sets and scale them by the size of `src`; also both centres and the size."""
    finite = jnp.isfinite(src).all(-1) & jnp.isfinite(dst).all(-1) & jnp.isfinite(weights)
    weights = jnp.where(finite, jnp.maximum(weights, 0), 0)
    usable = (weights > 0).astype(src.dtype)
    src, dst = (jnp.where(usable[:, None] > 0, points, 0) for points in (src, dst))
    src_centre, dst_centre = _centre(src, usable), _centre(dst, usable)
    src, dst = usable[:, None] * (src - src_centre), usable[:, None] * (dst - dst_centre)
    size = jax.lax.stop_gradient(jnp.max(jnp.abs(src)))
    size = jnp.where(size > 0, size, 1)
    count = weights.size
    rows = 0 if count <= BLOCK else -count % BLOCK
    problem = Problem(src / size, dst / size, weights, noise_bound / size)
    padded = jax.tree.map(lambda x: x if x.ndim == 0 else jnp.pad(x, ((0, rows),) + ((0, 0),) * (x.ndim - 1)), problem)
    return padded, src_centre, dst_centre, size


def lift_covariance(
    covariance: Float[Array, "6 6"], centre: Float[Array, "3"], size: Float[Array, ""]
) -> Float[Array, "6 6"]:
    """Covariance of the tangent at the origin of `src` from that at its centre in units of `size`: v + centre × ω."""
    x, y, z = centre
    zero = jnp.zeros_like(x)
    skew = jnp.stack([jnp.stack([zero, -z, y]), jnp.stack([z, zero, -x]), jnp.stack([-y, x, zero])])
    eye = jnp.eye(3, dtype=covariance.dtype)
    lift = jnp.block([[eye * size, skew], [jnp.zeros_like(eye), eye]])
    return jnp.einsum("ij,jk,lk->il", lift, covariance, lift, precision=Precision.HIGHEST)


def _fit(consensus: Consensus, problem: Problem, frozen: Problem, covariances, config: RegisterConfig):
    """Robust least squares from the consensus: motion, problem at its bound, whitener, law, scale, convergence."""
    law = ResidualLaw.of_bound(problem.src.dtype)
    if covariances is None:
        start, bound = narrow_bound(consensus.motions, frozen, config)
        problem, level = problem.at_bound(bound), frozen.at_bound(bound)
        whitener = isotropic_whitener(problem)
    else:
        eye = jnp.broadcast_to(jnp.eye(3, dtype=problem.src.dtype), covariances.shape)
        whitener = jax.scipy.linalg.solve_triangular(jnp.linalg.cholesky(covariances), eye, lower=True)
        start, level = approach(consensus.motions[0], frozen, whitener, law, _WHITENED_STEPS), frozen
    held = jax.lax.stop_gradient(whitener)
    factor = jnp.ones((), problem.src.dtype)
    if config.estimate_scale:

        def fit(motion, scaled):
            motion = approach(motion, scaled, whitener, law, config.approach_steps)
            return motion, scaled.weights * inlier_probability(whitened_residuals(motion, scaled, whitener))

        start, factor = refine_scale(start, level, fit)
        problem, level = (dataclasses.replace(p, src=p.src * factor) for p in (problem, level))
    law = fit_law(whitened_residuals(start, level, held), level.weights)
    start = approach(start, level, held, law, config.approach_steps)
    motion, converged = final_solve(start, problem, whitener, law, config)
    return motion, problem, whitener, law, factor, converged


def solve(
    src: Float[Array, "n 3"],
    dst: Float[Array, "n 3"],
    weights: Float[Array, " n"],
    covariances: Float[Array, "n 3 3"] | None,
    noise_bound: Float[Array, ""],
    key: PRNGKeyArray,
    config: RegisterConfig,
) -> Registration:
    """`register` without its checks and its padding."""
    count = weights.size
    problem, src_centre, dst_centre, size = _prepare(src, dst, weights, noise_bound)
    frozen = jax.lax.stop_gradient(problem)
    scale = jnp.ones((), src.dtype)
    if config.estimate_scale:
        scale = vote_scale(frozen)
        problem, frozen = (dataclasses.replace(p, src=p.src * scale) for p in (problem, frozen))
    consensus = find_consensus(frozen, key, config)
    problem, frozen = problem.at_bound(consensus.bound), frozen.at_bound(consensus.bound)
    if covariances is not None:
        eye = jnp.eye(3, dtype=src.dtype)
        rows = ((0, problem.weights.size - count), (0, 0), (0, 0))
        known = (jnp.pad(weights, rows[0]) > 0)[:, None, None]
        covariances = jnp.where(known, jnp.pad(covariances, rows) / size**2, eye)
    motion, problem, whitener, law, factor, converged = _fit(consensus, problem, frozen, covariances, config)

    whitened = whitened_residuals(motion, problem, whitener)
    probability = jnp.where(problem.weights > 0, inlier_probability(whitened), 0)
    inlier = (jnp.sum(whitened * whitened, axis=-1) < BOUND_IN_SIGMA**2) & (problem.weights > 0)
    squared = jnp.sum((motion.apply(problem.src) - problem.dst) ** 2, axis=-1)
    inliers, usable = jnp.sum(inlier), jnp.sum(problem.weights > 0)
    trust = problem.weights * law.trust(jnp.sum(whitened * whitened, axis=-1))
    covariance = jnp.linalg.pinv(normal_equations(motion, problem, whitener, trust)[0], hermitian=True)
    axis = free_axis(problem, probability, config)

    sure = jnp.where(usable >= 3, confidence(consensus.distinction, covariance, axis), 0)
    result = jnp.where(converged, int(Result.SUCCESS), int(Result.NOT_CONVERGED))
    result = jnp.where(consensus.distinction < config.min_distinction, int(Result.NO_CONSENSUS), result)
    result = jnp.where(usable < 3, int(Result.TOO_FEW_POINTS), result)

    remaining = jnp.where(inlier, 0, problem.weights)
    second, votes = find_second(frozen.weighed(remaining), config)
    stands_out = distinction(votes, consensus.null, vote(frozen)) > config.settle
    second_inliers = jnp.where(stands_out, jnp.round(votes), 0).astype(jnp.int32)

    def world(local: SE3, factor) -> SE3:
        turned = SE3(local.quat, jnp.zeros_like(local.xyz)).apply(src_centre[None])[0]
        moved = SE3(local.quat, local.xyz * size + dst_centre - scale * factor * turned)
        return jax.tree.map(lambda a, b: jnp.where(usable >= 3, a, b), moved, SE3.identity(dtype=src.dtype))

    return Registration(
        dst_from_src=world(motion, factor),
        inlier_weights=probability[:count],
        inliers=inliers,
        residual=jnp.sqrt(jnp.sum(jnp.where(inlier, squared, 0)) / jnp.maximum(inliers, 1)) * size,
        scale=scale * factor,
        covariance=lift_covariance(covariance, scale * factor * src_centre, size),
        result=result,
        confidence=sure,
        distinction=consensus.distinction,
        noise_bound=problem.bound * size,
        ambiguous_axis=axis,
        second=world(second, 1),
        second_inliers=second_inliers,
    )


solve_compiled = eqx.filter_jit(solve)
