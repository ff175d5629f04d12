"""Which photographs look alike: global descriptors, so that the work grows with the update and not with the map."""

from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, Int

from ltgs_jax.features import dense_descriptors
from ltgs_jax.io import as_rgb, read_pixels, resize_image, scaled_size

_THUMBNAIL = (128, 96)  # pixels, width first
_CELLS = 4


def global_descriptor(image: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, " d"]:
    """Unit descriptor of a photograph: its dense descriptors pooled over a 4 × 4 grid, less their common mean."""
    small = cv2.resize(image, _THUMBNAIL, interpolation=cv2.INTER_AREA)
    features = dense_descriptors(small, stride=2).features
    rows, columns = (
        np.array_split(np.arange(features.shape[0]), _CELLS),
        np.array_split(np.arange(features.shape[1]), _CELLS),
    )
    pooled = np.stack([features[np.ix_(r, c)].mean(axis=(0, 1)) for r in rows for c in columns])
    # Cells that look like the rest of the picture say little about where it was taken.
    pooled = np.concatenate([pooled - pooled.mean(axis=0), 0.5 * pooled.mean(axis=0, keepdims=True)]).ravel()
    return pooled / np.maximum(np.linalg.norm(pooled), 1e-12)


def photograph_descriptor(path: Path) -> Float[np.ndarray, " d"]:
    """The global descriptor of a photograph on disk, as it is stored."""
    image = as_rgb(read_pixels(path))
    return global_descriptor(resize_image(image, scaled_size(image.shape[1], image.shape[0], 160)))


def most_alike(
    query: Float[np.ndarray, " d"], descriptors: Float[np.ndarray, "c d"], count: int
) -> Int[np.ndarray, " k"]:
    """Indices of the `count` most alike, best first."""
    return np.argsort(-(descriptors @ query), kind="stable")[:count]
