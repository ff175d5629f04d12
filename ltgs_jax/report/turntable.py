"""Each template rendered alone, from a few sides."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ltgs_jax.geometry import SE3, Camera, quat_from_rotmat, stack_cameras
from ltgs_jax.render import RenderConfig, RenderPlan, plan_render, render
from ltgs_jax.scene import Chronology, Splats

_SIDE = 144  # pixels
_AZIMUTHS = np.radians([20, 110, 200, 290])
_ELEVATION = np.radians(25)
_DISTANCE = 4.0  # radii from the middle
_MARGIN = 1.2


def up_direction(cameras: list[Camera]) -> Float[np.ndarray, "3"]:
    """What the photographers held upward, on the average; −y, COLMAP's habit, when nobody did."""
    ups = [-np.asarray(camera.cam_from_world.rotmat(), np.float64)[1] for camera in cameras]
    mean = np.mean(ups, axis=0) if ups else np.zeros(3)
    length = np.linalg.norm(mean)
    return mean / length if length > 1e-3 else np.array([0.0, -1.0, 0.0])


def turntable(chronology: Chronology, up: Float[np.ndarray, "3"]) -> list[Float[np.ndarray, "views h w 4"]]:
    """Every template from four sides and a little above: colours and alpha in 0..1, by template.

    One program serves all: the templates are padded to one count and share a plan.
    """
    templates = [template.splats for template in chronology.templates]
    count = max((splats.count for splats in templates), default=0)
    if not count:
        return [np.zeros((len(_AZIMUTHS), _SIDE, _SIDE, 4))] * len(templates)
    padded = [_padded(splats, count) for splats in templates]
    rings = [_ring(np.asarray(splats.means, np.float64), up) for splats in templates]
    # In units of the object's own radius, so that the near plane means the same for all.
    near = min((radius for _, radius in rings), default=1.0) * 0.1
    config = RenderConfig(near=near)
    plans = [plan_render(p, c, config=config, slack=1) for p, (c, _) in zip(padded, rings, strict=True)]
    plan = RenderPlan(max(p.intersections for p in plans), max(p.rounds for p in plans))
    images = []
    for splats, (cameras, _) in zip(padded, rings, strict=True):
        seen = render(splats, cameras, plan=plan, config=config)
        alpha = np.asarray(seen.alpha)[..., None]
        colors = np.asarray(seen.image) / np.maximum(alpha, 1e-6)
        images.append(np.clip(np.concatenate([colors, alpha], axis=-1), 0, 1))
    return images


def _padded(splats: Splats, count: int) -> Splats:
    """The same with splats of no opacity after it; their degree of SH does not matter."""
    missing = count - splats.count
    filled = jax.tree.map(lambda x: jnp.pad(x, [(0, missing)] + [(0, 0)] * (x.ndim - 1)), splats)
    logits = jnp.where(jnp.arange(count) < splats.count, filled.logit_opacities, -jnp.inf)
    quats = filled.quats.at[splats.count :, 0].set(1)
    return Splats(filled.means, quats, filled.log_scales, logits, filled.sh)


def _ring(points: Float[np.ndarray, "n 3"], up: Float[np.ndarray, "3"]) -> tuple[Camera, float]:
    """Cameras around points, and the radius that they look at."""
    middle = np.median(points, axis=0) if len(points) else np.zeros(3)
    distances = np.linalg.norm(points - middle, axis=1)
    radius = max(float(np.quantile(distances, 0.98)) if len(points) else 1.0, 1e-6)
    side = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    side /= np.linalg.norm(side)
    ahead = np.cross(up, side)
    focal = _SIDE / 2 * _DISTANCE / _MARGIN
    K = jnp.asarray([[focal, 0, _SIDE / 2], [0, focal, _SIDE / 2], [0, 0, 1]], jnp.float32)
    cameras = []
    for azimuth in _AZIMUTHS:
        outward = np.cos(azimuth) * side + np.sin(azimuth) * ahead
        outward = np.cos(_ELEVATION) * outward + np.sin(_ELEVATION) * up
        right = np.cross(-up, -outward)
        right /= np.linalg.norm(right)
        rotmat = np.stack([right, np.cross(-outward, right), -outward])
        xyz = -rotmat @ (middle + _DISTANCE * radius * outward)
        pose = SE3(quat_from_rotmat(jnp.asarray(rotmat, jnp.float32)), jnp.asarray(xyz, jnp.float32))
        cameras.append(Camera(pose, K, _SIDE, _SIDE))
    return stack_cameras(cameras), radius
