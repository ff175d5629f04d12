"""Pinhole cameras in OpenCV axes."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.lax import Precision
from jaxtyping import Array, Float

from .se3 import SE3


class Camera(eqx.Module):
    """A pinhole camera, or a batch of equal image size.

    `cam_from_world` SE(3) with x right, y down, z forward; `K` [... 3 3] in pixels, the image's corner at (0, 0) and
    the first pixel's centre at (0.5, 0.5); `width`, `height` in pixels, static.
    """

    cam_from_world: SE3
    K: Float[Array, "... 3 3"]
    width: int = eqx.field(static=True)
    height: int = eqx.field(static=True)

    def center(self) -> Float[Array, "... 3"]:
        """Camera centre in the world."""
        return self.cam_from_world.inverse().xyz

    @jax.jit
    def project(self, points: Float[Array, "... n 3"]) -> tuple[Float[Array, "... n 2"], Float[Array, "... n"]]:
        """Pixels and camera z of world points; pixels mean nothing where z ≤ 0."""
        local = self.cam_from_world.apply(points)
        z = local[..., 2]
        safe = jnp.where(z == 0, 1, z)
        focal = jnp.stack([self.K[..., 0, 0], self.K[..., 1, 1]], axis=-1)[..., None, :]
        centre = self.K[..., None, :2, 2]
        return local[..., :2] / safe[..., None] * focal + centre, z

    @jax.jit
    def unproject(self, pixels: Float[Array, "... n 2"], depths: Float[Array, "... n"]) -> Float[Array, "... n 3"]:
        """World points at pixel positions and camera z."""
        focal = jnp.stack([self.K[..., 0, 0], self.K[..., 1, 1]], axis=-1)[..., None, :]
        xy = (pixels - self.K[..., None, :2, 2]) / focal * depths[..., None]
        return self.cam_from_world.inverse().apply(jnp.concatenate([xy, depths[..., None]], axis=-1))

    @jax.jit
    def rays(self, pixels: Float[Array, "n 2"]) -> tuple[Float[Array, "3"], Float[Array, "n 3"]]:
        """Centre and unit directions in the world of pixel positions."""
        xy = (pixels - self.K[:2, 2]) / jnp.stack([self.K[0, 0], self.K[1, 1]])
        local = jnp.concatenate([xy, jnp.ones_like(xy[:, :1])], axis=-1)
        local = local / jnp.linalg.norm(local, axis=-1, keepdims=True)
        world = jnp.einsum("ji,nj->ni", self.cam_from_world.rotmat(), local, precision=Precision.HIGHEST)
        return self.center(), world

    def resized(self, width: int, height: int) -> "Camera":
        """The same camera for an image scaled to `width` × `height`."""
        scale = jnp.asarray([width / self.width, height / self.height, 1], self.K.dtype)
        return Camera(self.cam_from_world, self.K * scale[:, None], width, height)

    def __getitem__(self, index) -> "Camera":
        """Index the leading axes."""
        return jax.tree.map(lambda leaf: leaf[index], self)


def stack_cameras(cameras: list[Camera]) -> Camera:
    """One batched camera from several of equal size.

    Raises ValueError when the list is empty or the sizes differ.
    """
    if not cameras:
        raise ValueError("cameras: expected at least one camera, got none")
    sizes = sorted({(camera.width, camera.height) for camera in cameras})
    if len(sizes) > 1:
        raise ValueError(f"cameras: expected one image size in a batch, got {sizes}")
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *cameras)
