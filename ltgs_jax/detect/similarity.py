"""How alike a rendered and a captured image are, pixel by pixel, and which difference was to be expected."""

import cv2
import numpy as np
from jaxtyping import Float
from skimage.metrics import structural_similarity

from ltgs_jax.features import FrontEnd


def similarity(
    rendered: Float[np.ndarray, "h w 3"], captured: Float[np.ndarray, "h w 3"], front_end: FrontEnd, *, gamma: float
) -> Float[np.ndarray, "h w"]:
    """γ·cos(E(I), E(Î)) + (1−γ)·SSIM(I, Î) (supplement of the LTGS paper, coarse masks); 1 where nothing differs."""
    cosine = _cosine_map(rendered, captured, front_end)
    _, structure = structural_similarity(
        rendered, captured, channel_axis=-1, data_range=1.0, gaussian_weights=True, sigma=1.5, full=True
    )
    return (gamma * cosine + (1 - gamma) * structure.mean(axis=-1)).astype(np.float32)


def _cosine_map(rendered: np.ndarray, captured: np.ndarray, front_end: FrontEnd) -> np.ndarray:
    """Cosine of the dense descriptors at every pixel."""
    a, b = front_end.describe(rendered), front_end.describe(captured)
    cosine = np.sum(a.features * b.features, axis=-1)
    h, w = rendered.shape[:2]
    return cosine if cosine.shape == (h, w) else cv2.resize(cosine, (w, h), interpolation=cv2.INTER_LINEAR)
