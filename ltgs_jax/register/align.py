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


def _horn_matrix(h: list[list[Float[Array, " s"]]]) -> list[list[Float[Array, " s"]]]:
    """Upper triangle of the symmetric 4×4 matrix whose leading eigenvector is the wxyz quaternion of d ≈ R·s.

    From H = Σ s dᵀ (Horn 1987), one array per entry: small matrices vectorise over hypotheses, not inside.
    """
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = h
    return [
        [xx + yy + zz, yz - zy, zx - xz, xy - yx],
        [xx - yy - zz, xy + yx, zx + xz],
        [yy - xx - zz, yz + zy],
        [zz - xx - yy],
    ]


def _leading_quat(upper: list[list[Float[Array, " s"]]]) -> list[Float[Array, " s"]]:
    """Unit eigenvector of the largest eigenvalue, by squaring of the matrix shifted to be positive."""
    places = [(i, j) for i in range(4) for j in range(i, 4)]
    entries = {(i, j): upper[i][j - i] for i, j in places}
    tiny = jnp.finfo(entries[0, 0].dtype).tiny
    norm = jnp.sqrt(sum((1 if i == j else 2) * entries[i, j] ** 2 for i, j in places))
    scale = jnp.where(norm > tiny, 1 / jnp.maximum(norm, tiny), 0)
    start = tuple(entries[i, j] * scale + (1 if i == j else 0) for i, j in places)

    def full(power):
        at = dict(zip(places, power, strict=True))
        return [[at[min(i, j), max(i, j)] for j in range(4)] for i in range(4)]

    def square(_, power):
        m = full(power)
        squared = [sum(m[i][k] * m[k][j] for k in range(4)) for i, j in places]
        trace = sum(value for value, (i, j) in zip(squared, places, strict=True) if i == j)
        return tuple(value / trace for value in squared)

    m = full(jax.lax.fori_loop(0, _SQUARINGS, square, start))
    column, largest = [m[i][0] for i in range(4)], m[0][0]
    for k in range(1, 4):
        larger = m[k][k] > largest
        column = [jnp.where(larger, m[i][k], c) for i, c in enumerate(column)]
        largest = jnp.where(larger, m[k][k], largest)
    length = jnp.sqrt(sum(c * c for c in column))
    return [c / length for c in column]


def align(
    weights: Float[Array, "s n"], moments: Float[Array, "n 16"]
) -> tuple[Float[Array, "s 4"], Float[Array, "s 3"]]:
    """Quaternions and translations that minimise Σ w|R·s + t − d|² for each row of weights (Horn 1987).

    Points on a line or in one point give one of the equally good rotations, never a reflection.
    """
    sums = jnp.matmul(weights, moments, precision=Precision.HIGHEST)
    total = jnp.maximum(sums[:, 0], jnp.finfo(sums.dtype).tiny)
    means = [sums[:, k] / total for k in range(1, 16)]
    src_mean, dst_mean = means[:3], means[3:6]
    spread = [[means[6 + 3 * i + j] - src_mean[i] * dst_mean[j] for j in range(3)] for i in range(3)]
    quats = jnp.stack(_leading_quat(_horn_matrix(spread)), axis=-1)
    return quats, jnp.stack(dst_mean, axis=-1) - rotate(quats, jnp.stack(src_mean, axis=-1))


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
