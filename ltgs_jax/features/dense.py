"""Dense colour and gradient descriptors, in the manner of DAISY (Tola et al. 2010) and HOG, with cosines that mean
something: every block is a unit vector whose dot product falls smoothly from 1 with the difference it measures, so the
cosine of two descriptors is the weighted mean of the blocks' agreements."""

import cv2
import numpy as np
from jaxtyping import Float

from .protocol import Dense, Image, check_image

_LOG_OFFSET = 0.02  # linear light added before the logarithm: about the noise floor of an 8-bit photograph
_GRADIENT_FLOOR = 0.06  # gradient in nats per pixel at which structure weighs as much as flatness
_BINS = 8


def _log_light(image: Image) -> Float[np.ndarray, "h w 3"]:
    """Logarithm of linear light per channel: exposure and white balance are then added constants."""
    linear = np.where(image <= 0.04045, image / 12.92, ((np.maximum(image, 0) + 0.055) / 1.055) ** 2.4)
    return np.log(linear + _LOG_OFFSET).astype(np.float32)


def _circle(value: np.ndarray, *, gain: float) -> list[np.ndarray]:
    """A scalar as a point on the unit half-circle: the dot product of two is cos of their squashed difference."""
    angle = np.float32(np.pi / 2) * np.tanh(gain * value)
    return [np.cos(angle), np.sin(angle)]


def _gradient_block(light: Float[np.ndarray, "h w"], sigma: float) -> Float[np.ndarray, "h w bins1"]:
    """Histogram of gradient directions around each pixel, and one channel that is 1 where there is no gradient.

    Without that channel the noise of flat regions, normalised, would count as texture that disagrees.
    """
    smooth = cv2.GaussianBlur(light, (0, 0), sigma)
    gx = cv2.Sobel(smooth, cv2.CV_32F, 1, 0, ksize=3, scale=0.125) * sigma
    gy = cv2.Sobel(smooth, cv2.CV_32F, 0, 1, ksize=3, scale=0.125) * sigma
    angles = 2 * np.pi * np.arange(_BINS, dtype=np.float32) / _BINS
    # Rectified projections on 8 directions; cubing them narrows a lobe to about one bin (DAISY takes the plain ones).
    magnitude = np.sqrt(gx * gx + gy * gy) + np.float32(1e-12)
    lobes = np.maximum((gx[..., None] * np.cos(angles) + gy[..., None] * np.sin(angles)) / magnitude[..., None], 0)
    histogram = cv2.GaussianBlur(lobes * lobes * lobes * magnitude[..., None], (0, 0), 1.5 * sigma)
    energy = np.linalg.norm(histogram, axis=-1, keepdims=True)
    angle = np.float32(np.pi / 2) * energy / (energy + _GRADIENT_FLOOR)
    return np.concatenate([histogram * (np.sin(angle) / np.maximum(energy, 1e-12)), np.cos(angle)], axis=-1)


def _ring(block: Float[np.ndarray, "h w d"], radius: int) -> list[Float[np.ndarray, "h w d"]]:
    """The block at the pixel and at four neighbours, edges repeated."""
    h, w = block.shape[:2]
    padded = np.pad(block, ((radius, radius), (radius, radius), (0, 0)), mode="edge")
    offsets = [(radius, radius), (0, radius), (2 * radius, radius), (radius, 0), (radius, 2 * radius)]
    return [padded[y : y + h, x : x + w] for y, x in offsets]


def dense_descriptors(
    image: Image, *, stride: int = 2, scales: tuple[float, ...] = (1.0, 2.0, 4.0), colour_weight: float = 0.5
) -> Dense:
    """Colour and gradient descriptors.

    Args: `image` [h w 3] in [0, 1]; `stride` px; `scales` of the gradients, in strides; `colour_weight`, the share
    of colour in the cosine. Returns: unit descriptors; a global gain of the photograph changes none of the colour and
    gradient blocks, but for the floor of dark pixels. Raises ValueError on a malformed image.
    """
    image = check_image(image)
    h, w = image.shape[:2]
    grid_h, grid_w = -(-h // stride), -(-w // stride)
    padded = cv2.copyMakeBorder(image, 0, grid_h * stride - h, 0, grid_w * stride - w, cv2.BORDER_REPLICATE)
    small = cv2.resize(padded, (grid_w, grid_h), interpolation=cv2.INTER_AREA)
    log_rgb = _log_light(small)
    light = log_rgb.mean(axis=-1)
    surround = cv2.GaussianBlur(light, (0, 0), max(grid_h, grid_w) / 12)
    channels = [
        (log_rgb[..., 0] - log_rgb[..., 1], 1.5, 1.0),  # red against green
        (0.5 * (log_rgb[..., 0] + log_rgb[..., 1]) - log_rgb[..., 2], 1.0, 1.0),  # yellow against blue
        (light - surround, 0.7, 0.7),  # lightness against its surroundings
    ]
    colour: list[np.ndarray] = []
    colour_total = 2 * sum(weight**2 for _, _, weight in channels)
    for sigma in (0.7, 2.5):
        for value, gain, weight in channels:
            share = np.float32(weight * np.sqrt(colour_weight / colour_total))
            colour += [share * part for part in _circle(cv2.GaussianBlur(value, (0, 0), sigma), gain=gain)]
    structure: list[np.ndarray] = []
    for level, sigma in enumerate(scales):
        block = _gradient_block(light, sigma)
        structure += _ring(block, round(2 * sigma)) if level else [block]
    share = np.float32(np.sqrt((1 - colour_weight) / len(structure)))
    features = np.concatenate([np.stack(colour, axis=-1), *[share * block for block in structure]], axis=-1)
    features /= np.sqrt(np.einsum("hwd,hwd->hw", features, features))[..., None]
    return Dense(features, stride, len(colour))
