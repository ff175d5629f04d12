"""Closed-form weighted alignment of many hypotheses at once, from moments."""

import jax
import jax.numpy as jnp
from jax.lax import Precision
from jaxtyping import Array, Float

# λ₂/λ₁ of the shifted matrix to the power 2⁸: a gap of 5 % leaves 2e-6.
_SQUARINGS = 8


def alignment_moments(src: Float[Array, "n 3"], dst: Float[Array, "n 3"]) -> Float[Array, "n 16"]:
    """Per correspondence 1, s, d and s⊗d: weighted sums of these rows are all that an alignment needs."""
    cross = (src[:, :, None] * dst[:, None, :]).reshape(-1, 9)
    return jnp.concatenate([jnp.ones_like(src[:, :1]), src, dst, cross], axis=-1)


def _horn_matrix(h: Float[Array, "... 3 3"]) -> Float[Array, "... 4 4"]:
    """Symmetric matrix whose leading eigenvector is the wxyz quaternion of d ≈ R·s, from H = Σ s dᵀ (Horn 1987)."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = [[h[..., i, j] for j in range(3)] for i in range(3)]
    rows = [
        [xx + yy + zz, yz - zy, zx - xz, xy - yx],
        [yz - zy, xx - yy - zz, xy + yx, zx + xz],
        [zx - xz, xy + yx, yy - xx - zz, yz + zy],
        [xy - yx, zx + xz, yz + zy, zz - xx - yy],
    ]
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def _leading_quat(matrix: Float[Array, "... 4 4"]) -> Float[Array, "... 4"]:
    """Unit eigenvector of the largest eigenvalue, by squaring of the matrix shifted to be positive."""
    tiny = jnp.finfo(matrix.dtype).tiny
    norm = jnp.sqrt(jnp.sum(matrix * matrix, axis=(-2, -1), keepdims=True))
    eye = jnp.eye(4, dtype=matrix.dtype)
    shifted = jnp.where(norm > tiny, matrix / jnp.maximum(norm, tiny), 0) + eye

    def square(_, power):
        power = jnp.sum(power[..., :, :, None] * power[..., None, :, :], axis=-2)
        return power / jnp.trace(power, axis1=-2, axis2=-1)[..., None, None]

    power = jax.lax.fori_loop(0, _SQUARINGS, square, shifted)
    best = jnp.argmax(jnp.diagonal(power, axis1=-2, axis2=-1), axis=-1)
    column = jnp.take_along_axis(power, best[..., None, None], axis=-1)[..., 0]
    return column / jnp.sqrt(jnp.sum(column * column, axis=-1, keepdims=True))


def align(
    weights: Float[Array, "s n"], moments: Float[Array, "n 16"]
) -> tuple[Float[Array, "s 4"], Float[Array, "s 3"]]:
    """Quaternions and translations that minimise Σ w|R·s + t − d|² for each row of weights (Horn 1987).

    Points on a line or in one point give one of the equally good rotations, never a reflection.
    """
    sums = jnp.matmul(weights, moments, precision=Precision.HIGHEST)
    total = jnp.maximum(sums[:, :1], jnp.finfo(sums.dtype).tiny)
    means = sums[:, 1:] / total
    src_mean, dst_mean = means[:, :3], means[:, 3:6]
    spread = means[:, 6:].reshape(-1, 3, 3) - src_mean[:, :, None] * dst_mean[:, None, :]
    quats = _leading_quat(_horn_matrix(spread))
    return quats, dst_mean - rotate(quats, src_mean)


def rotate(quats: Float[Array, "s 4"], points: Float[Array, "s 3"]) -> Float[Array, "s 3"]:
    """One point per unit quaternion, rotated."""
    w, v = quats[:, :1], quats[:, 1:]
    twice = 2 * jnp.cross(v, points)
    return points + w * twice + jnp.cross(v, twice)


def squared_residuals(
    rotmats: Float[Array, "s 3 3"], xyz: Float[Array, "s 3"], src: Float[Array, "n 3"], dst: Float[Array, "n 3"]
) -> Float[Array, "s n"]:
    """|R·s + t − d|² of every hypothesis and correspondence, written elementwise so that it fuses into one loop."""
    total = jnp.zeros((), src.dtype)
    for row in range(3):
        moved = sum(rotmats[:, row, col, None] * src[None, :, col] for col in range(3))
        total = total + (moved + xyz[:, row, None] - dst[None, :, row]) ** 2
    return total
