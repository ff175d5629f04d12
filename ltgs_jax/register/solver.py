"""Robust 6-DoF registration of two point sets whose correspondences are mostly wrong."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from ltgs_jax.geometry import SE3

from .align import squared_residuals
from .consensus import confidence_against, find_consensus, find_second, vote
from .hypotheses import Problem
from .outcome import RegisterConfig, Registration, Result
from .refine import BOUND_IN_SIGMA, approach, final_solve, free_axis, information, inlier_probability

# Sizes to which concrete inputs are padded, so that compilation is rare.
_PADDED = (32, 64, 128, 256, 512, 1024, 2048, 4096, 8192)


def _normalize(src, dst, weights, noise_bound):
    """Centre both sets on their usable points and scale by the size of `src`; sizes of 0 stay 1."""
    usable = weights > 0
    total = jnp.maximum(jnp.sum(usable), 1).astype(src.dtype)
    src_center = jnp.sum(jnp.where(usable[:, None], src, 0), axis=0) / total
    dst_center = jnp.sum(jnp.where(usable[:, None], dst, 0), axis=0) / total
    src = jnp.where(usable[:, None], src - src_center, 0)
    dst = jnp.where(usable[:, None], dst - dst_center, 0)
    size = jnp.max(jnp.abs(src))
    size = jax.lax.stop_gradient(jnp.where(size > 0, size, 1))
    return Problem(src / size, dst / size, weights, noise_bound / size), src_center, dst_center, size


def _solve(src, dst, weights, covariances, noise_bound, key, config) -> Registration:
    """`register` on arrays of one dtype, all rows present."""
    finite = jnp.isfinite(src).all(-1) & jnp.isfinite(dst).all(-1) & jnp.isfinite(weights)
    weights = jnp.where(finite, jnp.maximum(weights, 0), 0)
    problem, src_center, dst_center, size = _normalize(
        jnp.where(finite[:, None], src, 0), jnp.where(finite[:, None], dst, 0), weights, noise_bound
    )
    frozen = jax.lax.stop_gradient(problem)
    consensus = find_consensus(frozen, key, config)
    problem, frozen = problem.at_bound(consensus.bound), frozen.at_bound(consensus.bound)

    eye = jnp.eye(3, dtype=src.dtype)
    sigma = problem.bound / BOUND_IN_SIGMA
    if covariances is None:
        whitener = jnp.broadcast_to(eye / sigma, (*weights.shape, 3, 3))
    else:
        factor = jnp.linalg.cholesky(jnp.where(finite[:, None, None], covariances / size**2, eye))
        whitener = jax.scipy.linalg.solve_triangular(factor, jnp.broadcast_to(eye, factor.shape), lower=True)
    start = approach(consensus.motion, frozen, jax.lax.stop_gradient(whitener), config.approach_steps)
    motion, converged = final_solve(start, problem, whitener, config)

    residuals = motion.apply(problem.src) - problem.dst
    whitened = jnp.einsum("nij,nj->ni", whitener, residuals)
    probability = jnp.where(weights > 0, inlier_probability(whitened), 0)
    squared = jnp.sum(residuals * residuals, axis=-1)
    inlier = (jnp.sum(whitened * whitened, axis=-1) < BOUND_IN_SIGMA**2) & (weights > 0)
    inliers = jnp.sum(inlier)
    usable = jnp.sum(weights > 0)
    info = information(motion, problem, whitener, probability * weights)

    unit = vote(problem)
    confidence = jnp.where(usable >= 3, confidence_against(consensus.score, consensus.null, unit), 0)
    result = jnp.where(converged, int(Result.SUCCESS), int(Result.NOT_CONVERGED))
    result = jnp.where(confidence < config.min_confidence, int(Result.NO_CONSENSUS), result)
    result = jnp.where(usable < 3, int(Result.TOO_FEW_POINTS), result)

    remaining = jnp.where(inlier, 0, weights)
    second, second_score = find_second(consensus, frozen, remaining, config)
    second_squared = squared_residuals(second.rotmat()[None], second.xyz[None], problem.src, problem.dst)[0]
    second_count = jnp.sum((second_squared < problem.bound**2) & (remaining > 0))
    second_confidence = confidence_against(second_score, consensus.null, unit)
    second_count = jnp.where(second_confidence > config.min_confidence, second_count, 0)

    def world(local: SE3) -> SE3:
        xyz = local.xyz * size + dst_center - SE3(local.quat, jnp.zeros(3, src.dtype)).apply(src_center[None])[0]
        moved = SE3(local.quat, xyz)
        identity = SE3.identity(dtype=src.dtype)
        return jax.tree.map(lambda a, b: jnp.where(usable >= 3, a, b), moved, identity)

    # The tangent at the origin of `src` from the one at its centre: v' = v·size + c × ω.
    x, y, z = src_center
    zero = jnp.zeros_like(x)
    skew = jnp.stack([jnp.stack([zero, -z, y]), jnp.stack([z, zero, -x]), jnp.stack([-y, x, zero])])
    lift = jnp.block([[eye * size, skew], [jnp.zeros((3, 3), src.dtype), eye]])
    covariance = lift @ jnp.linalg.pinv(info, hermitian=True) @ lift.T
    rms = jnp.sqrt(jnp.sum(jnp.where(inlier, squared, 0)) / jnp.maximum(inliers, 1)) * size
    return Registration(
        dst_from_src=world(motion),
        inlier_weights=probability,
        inliers=inliers,
        residual=rms,
        covariance=covariance,
        result=result,
        confidence=confidence,
        ambiguous_axis=free_axis(info, config),
        second=world(second),
        second_inliers=second_count,
    )


_solve_compiled = eqx.filter_jit(_solve)


def _check(src, dst, weights, covariances) -> None:
    if src.ndim != 2 or src.shape[1] != 3:
        raise ValueError(f"src: expected shape [n, 3], got {list(src.shape)}")
    if dst.shape != src.shape:
        raise ValueError(f"dst: expected the shape of src, {list(src.shape)}, got {list(dst.shape)}")
    if weights is not None and weights.shape != src.shape[:1]:
        raise ValueError(f"weights: expected shape {list(src.shape[:1])}, got {list(weights.shape)}")
    if covariances is not None and covariances.shape not in ((3, 3), (*src.shape, 3)):
        raise ValueError(f"covariances: expected [3, 3] or {[*src.shape, 3]}, got {list(covariances.shape)}")


def _pad(array: np.ndarray, count: int) -> np.ndarray:
    return np.concatenate([array, np.zeros((count - len(array), *array.shape[1:]), array.dtype)])


def register(
    src: Float[Array, "n 3"] | np.ndarray,
    dst: Float[Array, "n 3"] | np.ndarray,
    *,
    noise_bound: float | Float[Array, ""],
    weights: Float[Array, " n"] | np.ndarray | None = None,
    covariances: Float[Array, "..."] | np.ndarray | None = None,
    key: PRNGKeyArray | None = None,
    config: RegisterConfig = RegisterConfig(),
) -> Registration:
    """The rigid motion from `src` to `dst`, row i of one believed to be row i of the other, most of them wrongly.

    `src`, `dst` [n, 3] in any one unit; `noise_bound` the largest residual of an inlier in that unit (3.37 σ);
    `weights` [n] ≥ 0 trust in each correspondence, 0 = absent; `covariances` [3, 3] or [n, 3, 3] of the residuals in
    the frame of `dst`, which then decide what an inlier is, at 3.37 standard deviations; `key` of the permutation that
    the confidence is measured against.

    Hypotheses come from second-order spatial compatibility (Chen et al. 2022), each annealed with Geman-McClure
    weights; the best is refined by robust least squares on the tangent of SE(3) in optimistix. Concrete inputs are
    padded to a few sizes and solved by one compiled program each; traced inputs are taken as they are, so `jit`,
    `vmap` and `grad` (with respect to the points, implicitly through the final solve) apply.

    Raises ValueError for wrong shapes and for a bound that is not positive. A failure to register is no exception:
    read `result`.
    """
    arrays = [a for a in (src, dst, weights, covariances, noise_bound) if a is not None]
    traced = any(isinstance(a, jax.core.Tracer) for a in arrays)
    src, dst = (a if isinstance(a, jax.Array) else np.asarray(a) for a in (src, dst))
    if weights is not None and not isinstance(weights, jax.Array):
        weights = np.asarray(weights)
    if covariances is not None and not isinstance(covariances, jax.Array):
        covariances = np.asarray(covariances)
    _check(src, dst, weights, covariances)
    key = jax.random.key(0) if key is None else key
    dtype = jax.dtypes.canonicalize_dtype(np.result_type(src.dtype, dst.dtype, np.float32))
    count = src.shape[0]
    if traced:
        weights = jnp.ones(count, dtype) if weights is None else jnp.asarray(weights, dtype)
        if covariances is not None:
            covariances = jnp.broadcast_to(jnp.asarray(covariances, dtype), (count, 3, 3))
        bound = jnp.asarray(noise_bound, dtype)
        return _solve(jnp.asarray(src, dtype), jnp.asarray(dst, dtype), weights, covariances, bound, key, config)
    if not float(noise_bound) > 0 or not np.isfinite(float(noise_bound)):
        raise ValueError(f"noise_bound: expected a positive number, got {noise_bound}")
    return _register_concrete(src, dst, weights, covariances, float(noise_bound), key, config, np.dtype(dtype))


def _register_concrete(src, dst, weights, covariances, noise_bound, key, config, dtype) -> Registration:
    """Pad to one of few sizes, solve, and drop the padding.

    Both sets are centred in double precision first, so that a large common offset costs no digits.
    """
    count = len(src)
    padded = next((size for size in _PADDED if size >= count), count)
    src, dst = np.asarray(src, np.float64), np.asarray(dst, np.float64)
    weights = np.ones(count) if weights is None else np.asarray(weights, np.float64)
    usable = np.isfinite(src).all(1) & np.isfinite(dst).all(1) & np.isfinite(weights) & (weights > 0)
    src_center = src[usable].mean(0) if usable.any() else np.zeros(3)
    dst_center = dst[usable].mean(0) if usable.any() else np.zeros(3)
    weights = np.where(usable, weights, 0)
    src, dst = (np.where(usable[:, None], x - c, 0) for x, c in ((src, src_center), (dst, dst_center)))
    if covariances is not None:
        covariances = np.broadcast_to(np.asarray(covariances, np.float64), (count, 3, 3))
        rest = np.broadcast_to(np.eye(3), (padded - count, 3, 3))
        covariances = jnp.asarray(np.concatenate([covariances, rest]), dtype)
    answer = _solve_compiled(
        jnp.asarray(_pad(src, padded), dtype),
        jnp.asarray(_pad(dst, padded), dtype),
        jnp.asarray(_pad(weights, padded), dtype),
        covariances,
        jnp.asarray(noise_bound, dtype),
        key,
        config,
    )
    few = int(usable.sum()) < 3

    def shifted(motion: SE3) -> SE3:
        if few:
            return motion
        rotmat = np.asarray(motion.rotmat(), np.float64)
        return SE3(
            motion.quat, jnp.asarray(np.asarray(motion.xyz, np.float64) + dst_center - rotmat @ src_center, dtype)
        )

    x, y, z = src_center
    lift = np.eye(6)
    lift[:3, 3:] = [[0, -z, y], [z, 0, -x], [-y, x, 0]]
    covariance = jnp.asarray(lift @ np.asarray(answer.covariance, np.float64) @ lift.T, dtype)
    return eqx.tree_at(
        lambda r: (r.dst_from_src, r.second, r.covariance, r.inlier_weights),
        answer,
        (shifted(answer.dst_from_src), shifted(answer.second), covariance, answer.inlier_weights[:count]),
    )
