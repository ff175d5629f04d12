"""`register`: checks, and padding to few sizes."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from ltgs_jax.geometry import SE3

from .outcome import RegisterConfig, Registration
from .solver import solve, solve_compiled

# Sizes to which concrete inputs are padded, so that compilation is rare.
_PADDED = (64, 128, 256, 512, 1024, 2048, 4096, 8192)


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


def _array(value):
    return value if value is None or isinstance(value, jax.Array) else np.asarray(value)


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

    `src`, `dst` [n, 3] in any one unit; `noise_bound` the largest residual of an inlier in that unit (3.37 σ), which
    may be wrong by a factor of 4; `weights` [n] ≥ 0 trust in each correspondence, 0 = absent; `covariances` [3, 3] or
    [n, 3, 3] of the residuals in the frame of `dst`, which then decide what an inlier is, at 3.37 standard
    deviations; `key` of the permutation that the confidence is measured against, by default a fixed one.

    Hypotheses come from second-order spatial compatibility (Chen et al. 2022), each annealed with Geman-McClure
    weights; the best is refined by robust least squares on the tangent of SE(3) in optimistix. Concrete inputs are
    padded to a few sizes and solved by one compiled program each; traced inputs are taken as they are, so `jit`,
    `vmap` and `grad` (with respect to the points, implicitly through the final solve) apply.

    Raises ValueError for wrong shapes and for a bound that is not positive. A failure to register is no exception:
    read `result`. Not differentiable where the best hypothesis changes.
    """
    src, dst, weights, covariances = (_array(value) for value in (src, dst, weights, covariances))
    _check(src, dst, weights, covariances)
    key = jax.random.key(0) if key is None else key
    dtype = jax.dtypes.canonicalize_dtype(np.result_type(src.dtype, dst.dtype, np.float32))
    count = src.shape[0]
    if any(isinstance(value, jax.core.Tracer) for value in (src, dst, weights, covariances, noise_bound, key)):
        weights = jnp.ones(count, dtype) if weights is None else jnp.asarray(weights, dtype)
        if covariances is not None:
            covariances = jnp.broadcast_to(jnp.asarray(covariances, dtype), (count, 3, 3))
        bound = jnp.asarray(noise_bound, dtype)
        return solve(jnp.asarray(src, dtype), jnp.asarray(dst, dtype), weights, covariances, bound, key, config)
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
    src_centre, dst_centre = (x[usable].mean(0) if usable.any() else np.zeros(3) for x in (src, dst))
    weights = np.where(usable, weights, 0)
    src, dst = (np.where(usable[:, None], x - c, 0) for x, c in ((src, src_centre), (dst, dst_centre)))
    if covariances is not None:
        covariances = np.broadcast_to(np.asarray(covariances, np.float64), (count, 3, 3))
        covariances = _pad(np.where(usable[:, None, None], covariances, np.eye(3)), padded).astype(dtype)
    rows = [_pad(x, padded).astype(dtype) for x in (src, dst, weights)]
    answer = jax.device_get(solve_compiled(*rows, covariances, np.asarray(noise_bound, dtype), key, config))
    enough = usable.sum() >= 3
    shift = float(answer.scale) * src_centre

    def moved(motion: SE3) -> SE3:
        w, v = motion.quat[0].astype(np.float64), motion.quat[1:].astype(np.float64)
        norm = w * w + v @ v
        turned = ((w * w - v @ v) * shift + 2 * (v @ shift) * v + 2 * w * np.cross(v, shift)) / norm
        return SE3(motion.quat, (motion.xyz + dst_centre - turned).astype(dtype)) if enough else motion

    x, y, z = shift
    lift = np.eye(6)
    lift[:3, 3:] = [[0, -z, y], [z, 0, -x], [-y, x, 0]]
    answer = eqx.tree_at(
        lambda r: (r.dst_from_src, r.second, r.covariance, r.inlier_weights),
        answer,
        (
            moved(answer.dst_from_src),
            moved(answer.second),
            (lift @ answer.covariance @ lift.T).astype(dtype),
            answer.inlier_weights[:count],
        ),
    )
    return jax.tree.map(jnp.asarray, answer)
