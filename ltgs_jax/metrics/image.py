"""PSNR and SSIM, cheap under jit and reverse-mode differentiation."""

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

SSIM_RADIUS = 5  # the 11 × 11 window of Wang et al. 2004
_SSIM_SIGMA = 1.5
_C1, _C2 = 0.01**2, 0.03**2  # for a data range of 1
_TAPS = np.exp(-0.5 * (np.arange(SSIM_RADIUS + 1) / _SSIM_SIGMA) ** 2)
_WINDOW = (_TAPS / (2 * _TAPS.sum() - _TAPS[0])).tolist()  # centre first; Python floats do not promote float32


def psnr(
    image: Float[Array, "*b h w c"],
    target: Float[Array, "*b h w c"],
    mask: Bool[Array, "*b h w"] | Float[Array, "*b h w"] | None = None,
) -> Float[Array, "*b"]:
    """Peak signal-to-noise ratio in dB of images in [0, 1].

    `mask` weighs pixels: 1 counts, 0 does not. Equal images give infinity, an empty mask gives NaN.

    Raises ValueError when the shapes differ.
    """
    _check_shapes(image, target, mask)
    return -10 * jnp.log10(_masked_mean(jnp.square(image - target), mask))


def ssim(
    image: Float[Array, "*b h w c"],
    target: Float[Array, "*b h w c"],
    mask: Bool[Array, "*b h w"] | Float[Array, "*b h w"] | None = None,
) -> Float[Array, "*b"]:
    """Mean structural similarity of images in [0, 1], over the pixels whose whole window lies inside the image.

    Wang et al. 2004, equation 13, with a Gaussian window of 11 × 11 and σ = 1.5 px. `mask` weighs the pixels of the
    map (1 counts, 0 does not); a window still sees its neighbours whatever their mask. An empty mask gives NaN.

    Raises ValueError when the shapes differ or the images are smaller than the window.
    """
    _check_shapes(image, target, mask)
    size = 2 * SSIM_RADIUS + 1
    if min(image.shape[-3:-1]) < size:
        raise ValueError(f"image: expected at least {size} × {size} pixels, got {image.shape[-3:-1]}")
    return _mean_ssim(image, target, mask)


@jax.jit
def _mean_ssim(image: Array, target: Array, mask: Array | None) -> Array:
    similarity = _flat(ssim_map(image, target))
    if mask is None:
        return _mean_inside(similarity, image.shape[-1])
    weights = mask.astype(image.dtype)
    weighted = similarity * jnp.repeat(weights, image.shape[-1], axis=-1)
    return _mean_inside(weighted, image.shape[-1]) / _mean_inside(weights, 1)


@jax.custom_vjp
def ssim_map(image: Float[Array, "*b h w c"], target: Float[Array, "*b h w c"]) -> Float[Array, "*b h w c"]:
    """Structural similarity around every pixel, per channel, in (−1, 1].

    Beyond the border both images are black; `ssim` leaves those pixels out. Where rounding makes the variance of a flat
    window negative it is taken as 0, and no gradient flows through it. Reverse mode only; one derivative.
    """
    return _ssim_forward(image, target)[0]


def _ssim_parts(image: Array, target: Array, channels: int) -> tuple[Array, tuple[Array, ...]]:
    """The map over flat images, and what its gradient needs."""
    mean_x, mean_y = _blur(image, channels), _blur(target, channels)
    power = _blur(image * image + target * target, channels) - (mean_x * mean_x + mean_y * mean_y)
    covariance = _blur(image * target, channels) - mean_x * mean_y
    a1 = 2 * mean_x * mean_y + _C1
    a2 = 2 * covariance + _C2
    b1 = mean_x * mean_x + mean_y * mean_y + _C1
    b2 = jnp.maximum(power, 0) + _C2
    return a1 * a2 / (b1 * b2), (mean_x, mean_y, power, a1, a2, b1, b2)


def _ssim_forward(image: Array, target: Array) -> tuple[Array, tuple[Array, ...]]:
    similarity, parts = _ssim_parts(_flat(image), _flat(target), image.shape[-1])
    return similarity.reshape(image.shape), (image, target, similarity, *parts)


def _ssim_backward(residuals: tuple[Array, ...], cotangent: Array) -> tuple[Array, Array]:
    """The window is symmetric, so the adjoint of each blur is the same blur."""
    image, target, similarity, mean_x, mean_y, power, a1, a2, b1, b2 = residuals
    shape, channels = image.shape, image.shape[-1]
    image, target, cotangent = _flat(image), _flat(target), _flat(cotangent)
    by_product = 2 * a1 / (b1 * b2) * cotangent
    by_power = jnp.where(power > 0, -similarity / b2, 0) * cotangent
    cross = 2 * a2 / (b1 * b2) * cotangent - by_product
    own = -2 * similarity / b1 * cotangent - 2 * by_power
    product, square = _blur(by_product, channels), 2 * _blur(by_power, channels)
    of_image = _blur(cross * mean_y + own * mean_x, channels) + product * target + square * image
    of_target = _blur(cross * mean_x + own * mean_y, channels) + product * image + square * target
    return of_image.reshape(shape), of_target.reshape(shape)


ssim_map.defvjp(_ssim_forward, _ssim_backward)


def _flat(image: Array) -> Array:
    """Columns and channels as one axis: a loop over three channels innermost would not vectorise."""
    return image.reshape(*image.shape[:-2], -1)


def _blur(flat: Array, channels: int) -> Array:
    """The Gaussian window along rows and columns as shifted adds: a fraction of a convolution's time on a CPU."""
    for axis, stride in ((flat.ndim - 2, 1), (flat.ndim - 1, channels)):
        blur = partial(_blur_axis, axis=axis, stride=stride)
        flat = jax.lax.platform_dependent(flat, cpu=partial(_apart, blur), default=blur)
    return flat


def _apart(blur: Callable[[Array], Array], flat: Array) -> Array:
    """Keep a pass from being fused with its readers.

    XLA on the CPU computes a pass again inside each loop that reads it (gradient at 640 × 480: 103 ms against 26); it
    does not fuse across a branch. A NaN in the corner makes the result NaN throughout.
    """
    corner = flat[(0,) * flat.ndim]
    return jax.lax.cond(jnp.isnan(corner), lambda x: jnp.full_like(x, jnp.nan), blur, flat)


def _blur_axis(flat: Array, *, axis: int, stride: int) -> Array:
    length, border = flat.shape[axis], SSIM_RADIUS * stride
    padded = jnp.pad(flat, [(border, border) if i == axis else (0, 0) for i in range(flat.ndim)])

    def shifted(by: int) -> Array:
        start = border + by * stride
        return jax.lax.slice_in_dim(padded, start, start + length, axis=axis)

    total = _WINDOW[0] * flat
    for by in range(1, SSIM_RADIUS + 1):
        total = total + _WINDOW[by] * (shifted(by) + shifted(-by))
    return total


def _mean_inside(flat: Array, channels: int) -> Array:
    """Mean where the whole window lies inside the image.

    Two products instead of a sum: XLA on the CPU fuses a sum with the map and then leaves it unvectorised (6 ms against
    1.4 at 640 × 480).
    """
    rows, columns = (
        np.pad(np.full(length - 2 * border, 1 / (length - 2 * border)), border)
        for length, border in ((flat.shape[-2], SSIM_RADIUS), (flat.shape[-1], SSIM_RADIUS * channels))
    )
    by_row = jnp.matmul(flat, columns.astype(flat.dtype), precision=jax.lax.Precision.HIGHEST)
    return jnp.matmul(by_row, rows.astype(flat.dtype), precision=jax.lax.Precision.HIGHEST)


def _masked_mean(values: Array, mask: Array | None) -> Array:
    """Mean over rows, columns and channels, weighed by the mask."""
    if mask is None:
        return jnp.mean(values, axis=(-3, -2, -1))
    weights = mask.astype(values.dtype)
    count = jnp.sum(weights, axis=(-2, -1)) * values.shape[-1]
    return jnp.sum(values * weights[..., None], axis=(-3, -2, -1)) / count


def _check_shapes(image: Array, target: Array, mask: Array | None) -> None:
    if image.shape != target.shape:
        raise ValueError(f"target: expected the image's shape {image.shape}, got {target.shape}")
    if mask is not None and mask.shape != image.shape[:-1]:
        raise ValueError(f"mask: expected shape {image.shape[:-1]}, got {mask.shape}")
