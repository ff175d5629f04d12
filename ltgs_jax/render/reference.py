"""The slow renderer that the fast one is held to: every pixel times every splat, written from the definitions."""

import jax
import jax.numpy as jnp
from jax.lax import Precision
from jaxtyping import Array, Float

from ltgs_jax.geometry import Camera, eval_sh, rotmat_from_quat
from ltgs_jax.scene import Splats

from .config import ALPHA_MAX, ALPHA_MIN, EPS2D, TRANSMITTANCE_STOP, RenderOutput


def render_reference(
    splats: Splats,
    camera: Camera,
    *,
    background: Float[Array, " ch"] | None = None,
    colors: Float[Array, "n ch"] | None = None,
    near: float = 0.01,
) -> RenderOutput:
    """What `render` computes for one camera, by 3×3 covariances, an explicit conic and a scan over all splats.

    Meant for float64 and small scenes: time grows with pixels × splats, and reverse mode keeps as much memory. Knows
    nothing of tiles, of culling beyond the definitions, or of unusable inputs.
    """
    dtype = splats.means.dtype
    world = camera.cam_from_world.rotmat()
    local = camera.cam_from_world.apply(splats.means)
    order = jnp.argsort(local[:, 2], stable=True)
    kept = local[:, 2] >= near
    local = jnp.where(kept[:, None], local, jnp.asarray([0, 0, 1], dtype))
    x, y, z = local[:, 0], local[:, 1], local[:, 2]
    axes = rotmat_from_quat(splats.quats) * splats.scales[:, None, :]
    covars = jnp.einsum("nij,nkj->nik", axes, axes, precision=Precision.HIGHEST)
    fx, fy, cx, cy = camera.K[0, 0], camera.K[1, 1], camera.K[0, 2], camera.K[1, 2]
    tan_x = jnp.clip(x / z, (-cx - 0.15 * camera.width) / fx, (1.15 * camera.width - cx) / fx)
    tan_y = jnp.clip(y / z, (-cy - 0.15 * camera.height) / fy, (1.15 * camera.height - cy) / fy)
    zero = jnp.zeros_like(z)
    jacobian = jnp.stack(
        [jnp.stack([fx / z, zero, -fx * tan_x / z], -1), jnp.stack([zero, fy / z, -fy * tan_y / z], -1)], axis=-2
    )
    half = jnp.einsum("nij,jk->nik", jacobian, world, precision=Precision.HIGHEST)
    covars2d = jnp.einsum("nij,njk,nlk->nil", half, covars, half, precision=Precision.HIGHEST)
    a, b, c = covars2d[:, 0, 0] + EPS2D, covars2d[:, 0, 1], covars2d[:, 1, 1] + EPS2D
    det = a * c - b * b
    u, v = fx * x / z + cx, fy * y / z + cy
    if colors is None:
        offset = splats.means - camera.center()
        norm = jnp.linalg.norm(jnp.where(kept[:, None], offset, 1), axis=-1, keepdims=True)
        colors = eval_sh(splats.sh, jnp.where(kept[:, None], offset, 1) / norm)
    opacities = jnp.where(kept, splats.opacities, 0)
    px = jnp.arange(camera.width, dtype=dtype) + 0.5
    py = jnp.arange(camera.height, dtype=dtype)[:, None] + 0.5

    def blend(carry, splat):
        transmittance, total = carry
        u, v, a, b, c, det, opacity, channels = splat
        dx, dy = px - u, py - v
        sigma = 0.5 * (c * dx * dx - 2 * b * dx * dy + a * dy * dy) / det
        alpha = jnp.minimum(opacity * jnp.exp(-sigma), ALPHA_MAX)
        alpha = jnp.where((alpha >= ALPHA_MIN) & (transmittance > TRANSMITTANCE_STOP), alpha, 0)
        weight = alpha * transmittance
        return (transmittance * (1 - alpha), total + weight[..., None] * channels), None

    channels = jnp.concatenate([colors, z[:, None]], axis=-1)
    empty = jnp.zeros((camera.height, camera.width, channels.shape[1]), dtype)
    start = (jnp.ones((camera.height, camera.width), dtype), empty)
    ordered = jax.tree.map(lambda leaf: leaf[order], (u, v, a, b, c, det, opacities, channels))
    (transmittance, total), _ = jax.lax.scan(blend, start, ordered)
    image, alpha = total[..., :-1], 1 - transmittance
    if background is not None:
        image = image + transmittance[..., None] * background
    covered = alpha > 0
    depth = jnp.where(covered, total[..., -1] / jnp.where(covered, alpha, 1), 0)
    return RenderOutput(image, alpha, depth, jnp.zeros((), jnp.int32))
