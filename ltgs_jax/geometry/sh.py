"""Real spherical harmonics up to degree 3: values and rotation, in the basis order of 3DGS."""

import functools
import math

import jax.numpy as jnp
import numpy as np
from jax.lax import Precision
from jaxtyping import Array, Float

C0 = 0.28209479177387814
_C1 = 0.4886025119029199
_C2 = (1.0925484305920792, -1.0925484305920792, 0.31539156525252005, -1.0925484305920792, 0.5462742152960396)
_C3 = (
    -0.5900435899266435,
    2.890611442640554,
    -0.4570457994644658,
    0.3731763325901154,
    -0.4570457994644658,
    1.445305721320277,
    -0.5900435899266435,
)


def sh_degree(sh: Float[Array, "... k 3"]) -> int:
    """Degree of coefficients [... (degree+1)², 3]. Raises ValueError for any other count."""
    degree = math.isqrt(sh.shape[-2]) - 1
    if (degree + 1) ** 2 != sh.shape[-2] or not 0 <= degree <= 3:
        raise ValueError(f"sh: expected 1, 4, 9 or 16 coefficients, got {sh.shape[-2]}")
    return degree


def _band_values(x, y, z, band: int) -> list:
    """The 2·band+1 functions of one band, for JAX or NumPy arrays alike."""
    xx, yy, zz = x * x, y * y, z * z
    if band == 0:
        return [C0 + 0 * x]
    if band == 1:
        return [-_C1 * y, _C1 * z, -_C1 * x]
    if band == 2:
        terms = [x * y, y * z, 2 * zz - xx - yy, x * z, xx - yy]
        return [c * term for c, term in zip(_C2, terms, strict=True)]
    terms = [
        y * (3 * xx - yy),
        x * y * z,
        y * (4 * zz - xx - yy),
        z * (2 * zz - 3 * xx - 3 * yy),
        x * (4 * zz - xx - yy),
        z * (xx - yy),
        x * (xx - 3 * yy),
    ]
    return [c * term for c, term in zip(_C3, terms, strict=True)]


def sh_basis(directions: Float[Array, "... 3"], degree: int) -> Float[Array, "... k"]:
    """Values of the (degree+1)² basis functions at unit directions."""
    x, y, z = jnp.moveaxis(directions, -1, 0)
    return jnp.stack([value for band in range(degree + 1) for value in _band_values(x, y, z, band)], axis=-1)


def eval_sh(sh: Float[Array, "... k 3"], directions: Float[Array, "... 3"]) -> Float[Array, "... 3"]:
    """Colours max(SH·direction + 0.5, 0) at unit directions; not differentiable where a channel crosses 0."""
    basis = sh_basis(directions, sh_degree(sh))
    return jnp.maximum(jnp.sum(sh * basis[..., None], axis=-2) + 0.5, 0)


@functools.cache
def _samples(degree: int) -> tuple[np.ndarray, np.ndarray]:
    """Fixed directions on a Fibonacci sphere and the pseudo-inverse of one band's basis there."""
    count = 4 * (2 * degree + 1)
    i = np.arange(count) + 0.5
    z = 1 - 2 * i / count
    phi = math.pi * (1 + 5**0.5) * i
    radius = np.sqrt(1 - z * z)
    directions = np.stack([radius * np.cos(phi), radius * np.sin(phi), z], axis=-1)
    return directions, np.linalg.pinv(np.stack(_band_values(*directions.T, degree), axis=-1))


def sh_rotations(rotmat: Float[Array, "*b 3 3"], degree: int) -> tuple[Float[Array, "*b m m"], ...]:
    """How a rotation turns the coefficients of each band from 1 to `degree`, m = 2·band + 1.

    A band is closed under rotation, so its matrix is the pseudo-inverse of the band at fixed directions times the band
    at the directions turned back: exact to rounding, differentiable in `rotmat`, free of recursions.
    """
    matrices = []
    for band in range(1, degree + 1):
        directions, inverse = _samples(band)
        turned = jnp.matmul(jnp.asarray(directions, rotmat.dtype), rotmat, precision=Precision.HIGHEST)
        values = sh_basis(turned, band)[..., band**2 :]
        matrices.append(jnp.matmul(jnp.asarray(inverse, rotmat.dtype), values, precision=Precision.HIGHEST))
    return tuple(matrices)


def rotate_sh(sh: Float[Array, "*b k 3"], rotations: tuple[Float[Array, "*#b m m"], ...]) -> Float[Array, "*b k 3"]:
    """Coefficients of the rotated function f'(d) = f(Rᵀd), band by band, by `sh_rotations` (equation 1 of the LTGS
    paper)."""
    bands = [sh[..., :1, :]]
    for band, matrix in enumerate(rotations, start=1):
        coefficients = sh[..., band**2 : (band + 1) ** 2, :]
        # A sum of products: as a batch of small products of matrices XLA's CPU backend is slower.
        bands.append(jnp.sum(matrix[..., None] * coefficients[..., None, :, :], axis=-2))
    return jnp.concatenate(bands, axis=-2)
