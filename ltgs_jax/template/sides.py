"""A known template from many sides: renders of it alone, with the point of its surface that each pixel shows."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from ltgs_jax.geometry import SE3, Camera
from ltgs_jax.render import RenderOutput, RenderPlan, plan_render, render
from ltgs_jax.scene import Splats, pad_splats

from .arrival import middle_of, shown_points
from .support import Support

_AROUND = 8  # sides from each height
_HEIGHTS = np.radians([15.0, 45.0])  # of the cameras above the plane through the template's middle
_AWAY = 6.0  # sizes of the template between its middle and a camera
_FILLS = 0.6  # of an image's edge, by the template's size
_GREY = 0.5  # around the template
_FIRM = 0.8  # alpha from which on a pixel shows the template's surface


class Sides(eqx.Module):
    """Renders of a template from m sides, and the point in its own frame that each pixel shows where it is firm."""

    images: Float[np.ndarray, "m s s 3"]
    points: Float[np.ndarray, "m s s 3"]
    firm: Bool[np.ndarray, "m s s"]


def render_sides(splats: Splats, support: Support, *, size: float, side: int) -> Sides:
    """A template, of this diameter in scene units, from all around and two heights above its support, in images of
    `side` × `side` pixels."""
    middle = middle_of(shown_points(splats))
    cameras = _cameras_around(support, middle, size, side)
    # To a power of two: each number of splats is another program.
    splats = jax.device_put(pad_splats(splats, 1 << max(splats.count - 1, 0).bit_length()))
    out = _rendered(splats, cameras, plan_render(splats, cameras))
    alpha, depth = np.asarray(out.alpha), np.asarray(out.depth)
    images = np.clip(np.asarray(out.image) + _GREY * (1 - alpha[..., None]), 0, 1)
    return Sides(images, points_of_depth(cameras, depth), alpha > _FIRM)


def points_of_depth(cameras: Camera, depth: Float[np.ndarray, "v h w"]) -> Float[np.ndarray, "v h w 3"]:
    """The points in the world that the pixels of v cameras show at these depths."""
    rows, columns = np.mgrid[: depth.shape[1], : depth.shape[2]] + 0.5
    pixels = np.stack([columns, rows], axis=-1).reshape(1, -1, 2).repeat(len(depth), axis=0)
    points = cameras.unproject(jnp.asarray(pixels, jnp.float32), jnp.asarray(depth.reshape(len(depth), -1)))
    return np.asarray(points).reshape(*depth.shape, 3)


def _cameras_around(support: Support, middle: Float[np.ndarray, "3"], size: float, side: int) -> Camera:
    """Cameras that look at the template's middle, upright above its support."""
    u, v, up = support.frame()
    matrices = []
    for height in _HEIGHTS:
        for angle in 2 * np.pi * (np.arange(_AROUND) + 0.5 * (height > _HEIGHTS[0])) / _AROUND:
            level = np.cos(angle) * u + np.sin(angle) * v
            away = np.cos(height) * level + np.sin(height) * up
            down = np.sin(height) * level - np.cos(height) * up
            rotation = np.stack([np.cross(down, -away), down, -away])
            matrix = np.eye(4)
            matrix[:3, :3], matrix[:3, 3] = rotation, -rotation @ (middle + _AWAY * size * away)
            matrices.append(matrix)
    focal = _FILLS * side * _AWAY
    K = np.tile([[focal, 0, side / 2], [0, focal, side / 2], [0, 0, 1]], (len(matrices), 1, 1))
    poses = SE3.from_matrix(jnp.asarray(np.stack(matrices), jnp.float32))
    return Camera(poses, jnp.asarray(K, jnp.float32), side, side)


@eqx.filter_jit
def _rendered(splats: Splats, cameras: Camera, plan: RenderPlan) -> RenderOutput:
    return render(splats, cameras, plan=plan)
