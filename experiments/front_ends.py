"""Front ends to compare the default one with. Only the dense descriptors differ; all else is the default's."""

import dataclasses
import zlib
from dataclasses import dataclass

import numpy as np

from ltgs_jax.features import Classical, Dense, check_image


@dataclass(frozen=True)
class Noisy(Classical):
    """The default front end with noise on every dense descriptor, the same for the same image.

    `sigma` root mean square length of the noise, relative to the descriptor's.
    """

    sigma: float = 0.0

    def describe(self, image: np.ndarray) -> Dense:
        """Unit descriptors [h' w' d]."""
        dense = super().describe(image)
        rng = np.random.default_rng(zlib.crc32(np.ascontiguousarray(image).tobytes()))
        shape = dense.features.shape
        features = dense.features + self.sigma / np.sqrt(shape[-1]) * rng.standard_normal(shape)
        features = features / np.linalg.norm(features, axis=-1, keepdims=True)
        return dataclasses.replace(dense, features=features.astype(np.float32))


@dataclass(frozen=True)
class Colours(Classical):
    """Three numbers a pixel, its colour as a unit vector: what a descriptor has to be better than."""

    def describe(self, image: np.ndarray) -> Dense:
        """Unit descriptors [h w 3]."""
        colours = check_image(image) + np.float32(1e-3)
        return Dense(colours / np.linalg.norm(colours, axis=-1, keepdims=True), 1, 3)
