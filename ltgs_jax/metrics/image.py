"""PSNR and SSIM, cheap under jit and reverse-mode differentiation."""

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
    inside = slice(SSIM_RADIUS, -SSIM_RADIUS)
    if mask is not None:
        mask = mask[..., inside, inside]
    return _masked_mean(ssim_map(image, target)[..., inside, inside, :], mask)


@jax.custom_vjp
def ssim_map(image: Float[Array, "*b h w c"], target: Float[Array, "*b h w c"]) -> Float[Array, "*b h w c"]:
    """Structural similarity around every pixel, per channel, in (−1, 1].

    Beyond the border both images are black; `ssim` leaves those pixels out. Where rounding makes the variance of a flat
    window negative it is taken as 0, and no gradient flows through it. Reverse mode only; one derivative.
    """
    return _ssim_parts(image, target)[0]


def _ssim_parts(image: Array, target: Array) -> tuple[Array, tuple[Array, ...]]:
    mean_x, mean_y = _blur(image), _blur(target)
    power = _blur(image * image + target * target) - (mean_x * mean_x + mean_y * mean_y)
    covariance = _blur(image * target) - mean_x * mean_y
    a1 = 2 * mean_x * mean_y + _C1
    a2 = 2 * covariance + _C2
    b1 = mean_x * mean_x + mean_y * mean_y + _C1
    b2 = jnp.maximum(power, 0) + _C2
    return a1 * a2 / (b1 * b2), (mean_x, mean_y, power, a1, a2, b1, b2)


def _ssim_forward(image: Array, target: Array) -> tuple[Array, tuple[Array, Array]]:
    return _ssim_parts(image, target)[0], (image, target)


def _ssim_backward(residuals: tuple[Array, Array], cotangent: Array) -> tuple[Array, Array]:
    """The window is symmetric, so the adjoint of each blur is the same blur."""
    image, target = residuals
    similarity, (mean_x, mean_y, power, a1, a2, b1, b2) = _ssim_parts(image, target)
    by_product = 2 * a1 / (b1 * b2) * cotangent
    by_power = jnp.where(power > 0, -similarity / b2, 0) * cotangent
    by_luminance = 2 * a2 / (b1 * b2) * cotangent
    by_energy = -2 * similarity / b1 * cotangent
    product, square = _blur(by_product), 2 * _blur(by_power)
    cross, own = by_luminance - by_product, by_energy - 2 * by_power
    of_image = _blur(cross * mean_y + own * mean_x) + product * target + square * image
    of_target = _blur(cross * mean_x + own * mean_y) + product * image + square * target
    return of_image, of_target


ssim_map.defvjp(_ssim_forward, _ssim_backward)


def _blur(image: Array) -> Array:
    """The Gaussian window along rows and columns as shifted adds: a twentieth of a convolution's time on a CPU."""
    return _blur_axis(_blur_axis(image, image.ndim - 3), image.ndim - 2)


def _blur_axis(image: Array, axis: int) -> Array:
    length = image.shape[axis]
    widths = [(0, 0)] * image.ndim
    widths[axis] = (SSIM_RADIUS, SSIM_RADIUS)
    padded = jnp.pad(image, widths)

    def shifted(by: int) -> Array:
        return jax.lax.slice_in_dim(padded, SSIM_RADIUS + by, SSIM_RADIUS + by + length, axis=axis)

    total = _WINDOW[0] * image
    for by in range(1, SSIM_RADIUS + 1):
        total = total + _WINDOW[by] * (shifted(by) + shifted(-by))
    return total


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
