"""What the scene's renderer may get wrong, to test what that does to a run."""

import zlib
from collections.abc import Sequence

import cv2
import equinox as eqx
import numpy as np

from ltgs_jax.geometry import Camera
from ltgs_jax.pipeline.looks import Eye, Look
from ltgs_jax.scene import Splats

_PATCH_PX = 16


class Blind(Eye):
    """The renderer, which expects nothing to look as it shows it in some cameras: their change masks are empty."""

    def __init__(self, cameras: Sequence[Camera]) -> None:
        super().__init__()
        self._poses = [np.asarray(camera.cam_from_world.as_matrix()) for camera in cameras]

    def look(self, splats: Splats, camera: Camera, errors: np.ndarray) -> Look:
        """As `Eye.look`, with other expectations in these cameras."""
        look = super().look(splats, camera, errors)
        pose = np.asarray(camera.cam_from_world.as_matrix())
        if any(np.allclose(pose, other, atol=1e-4) for other in self._poses):
            look = eqx.tree_at(lambda each: each.expected, look, np.full_like(look.expected, np.inf))
        return look


class NoisyDepth(Eye):
    """The renderer with depths that are wrong by smooth noise, the same for the same camera.

    `sigma`: its standard deviation, relative to the depth.
    """

    def __init__(self, sigma: float) -> None:
        super().__init__()
        self.sigma = sigma

    def look(self, splats: Splats, camera: Camera, errors: np.ndarray) -> Look:
        """As `Eye.look`, with other depths."""
        look = super().look(splats, camera, errors)
        rng = np.random.default_rng(zlib.crc32(np.asarray(camera.cam_from_world.as_matrix()).tobytes()))
        height, width = look.depth.shape
        coarse = rng.standard_normal((-(-height // _PATCH_PX), -(-width // _PATCH_PX))).astype(np.float32)
        noise = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_LINEAR)
        depth = look.depth * (1 + self.sigma * noise / noise.std())
        return eqx.tree_at(lambda each: each.depth, look, depth.astype(np.float32))
