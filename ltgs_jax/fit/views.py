"""Photographs as the fit sees them."""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from ltgs_jax.geometry import Camera
from ltgs_jax.render import RenderPlan, plan_render
from ltgs_jax.scene import Splats


class View(eqx.Module):
    """One photograph to fit: camera, image [h w 3] uint8, and the pixels that count [h w]."""

    camera: Camera
    image: np.ndarray
    mask: np.ndarray


def size_of(view: View) -> tuple[int, int]:
    """Width and height in pixels."""
    return view.camera.width, view.camera.height


def half_size(view: View) -> View:
    """The view at half resolution, by averaging 2×2 pixels; an odd last row or column is left out."""
    h, w = view.image.shape[0] // 2, view.image.shape[1] // 2
    blocks = view.image[: 2 * h, : 2 * w].astype(np.float32).reshape(h, 2, w, 2, 3)
    mask = view.mask[: 2 * h, : 2 * w].reshape(h, 2, w, 2).all(axis=(1, 3))
    camera = view.camera
    K = camera.K * jnp.asarray([[0.5], [0.5], [1]], camera.K.dtype)
    return View(Camera(camera.cam_from_world, K, w, h), np.rint(blocks.mean(axis=(1, 3))).astype(np.uint8), mask)


def scene_extent(cameras: Sequence[Camera]) -> float:
    """1.1 × the largest distance of a camera from their mean, as 3DGS scales its step for the means."""
    centers = np.stack([np.asarray(camera.center()) for camera in cameras])
    return float(1.1 * np.linalg.norm(centers - centers.mean(axis=0), axis=1).max()) or 1.0


def plan_for(pairs: Sequence[tuple[Splats, Camera]], *, slack: float = 1.3) -> RenderPlan:
    """One plan that serves each of these renders alone, so that one compilation does."""
    plans = [plan_render(splats, camera, slack=slack) for splats, camera in pairs]
    return RenderPlan(max(p.intersections for p in plans), max(p.rounds for p in plans))
