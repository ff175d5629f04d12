"""The photometric loss of 3DGS."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ltgs_jax.metrics import ssim_map


def photometric_loss(
    image: Float[Array, "h w 3"], target: Float[Array, "h w 3"], mask: Bool[Array, "h w"], *, dssim: float
) -> Float[Array, ""]:
    """(1−λ)·L1 + λ·(1−SSIM) over the pixels of `mask`, λ = `dssim`.

    Outside the mask the target replaces the image, so that SSIM windows across the border see no difference there.
    """
    inside = mask[..., None]
    image = jnp.where(inside, image, target)
    count = jnp.maximum(jnp.sum(mask), 1)
    l1 = jnp.sum(jnp.abs(image - target)) / (3 * count)
    if dssim == 0:
        return l1
    structure = jnp.sum(jnp.where(inside, 1 - ssim_map(image, target), 0)) / (3 * count)
    return (1 - dssim) * l1 + dssim * structure
