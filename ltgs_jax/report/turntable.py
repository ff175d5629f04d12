"""Each template rendered alone, from a few sides."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ltgs_jax.geometry import SE3, Camera, quat_from_rotmat, stack_cameras
from ltgs_jax.render import RenderPlan, plan_render, render
from ltgs_jax.scene import Chronology, Splats, pad_splats

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

    Templates are brought to one middle, one size and one count of splats, and capacities are rounded up, so that one
    compiled program serves all of them, and mostly the next run too.
    """
    templates = [template.splats for template in chronology.templates]
    count = max((splats.count for splats in templates), default=0)
    if not count:
        return [np.zeros((len(_AZIMUTHS), _SIDE, _SIDE, 4))] * len(templates)
    alike = [_normalized(splats, _power_of_two(count)) for splats in templates]
    cameras = _ring(up)
    plans = [plan_render(splats, cameras, slack=1) for splats in alike]
    plan = RenderPlan(
        _power_of_two(max(plan.intersections for plan in plans)), _power_of_two(max(plan.rounds for plan in plans))
    )
    images = []
    for splats in alike:
        seen = render(splats, cameras, plan=plan)
        alpha = np.asarray(seen.alpha)[..., None]
        colors = np.asarray(seen.image) / np.maximum(alpha, 1e-6)
        images.append(np.clip(np.concatenate([colors, alpha], axis=-1), 0, 1))
    return images


def _power_of_two(least: int) -> int:
    return 1 << max(0, least - 1).bit_length()


def _normalized(splats: Splats, count: int) -> Splats:
    """The same around the origin, most of it within a radius of 1; then splats of no opacity up to `count`."""
    points = np.asarray(splats.means, np.float64)
    middle = np.median(points, axis=0) if len(points) else np.zeros(3)
    distances = np.linalg.norm(points - middle, axis=1)
    radius = max(float(np.quantile(distances, 0.98)) if len(points) else 1.0, 1e-6)
    centred = eqx.tree_at(
        lambda s: (s.means, s.log_scales),
        splats,
        ((points - middle) / radius, np.asarray(splats.log_scales) - np.log(radius)),
    )
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, splats.means.dtype), pad_splats(centred, count))


def _ring(up: Float[np.ndarray, "3"]) -> Camera:
    """Cameras around the origin that look at it."""
    side = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    side /= np.linalg.norm(side)
    ahead = np.cross(up, side)
    focal = _SIDE / 2 * _DISTANCE / _MARGIN
    K = jnp.asarray([[focal, 0, _SIDE / 2], [0, focal, _SIDE / 2], [0, 0, 1]], jnp.float32)
    cameras = []
    for azimuth in _AZIMUTHS:
        outward = np.cos(azimuth) * side + np.sin(azimuth) * ahead
        outward = np.cos(_ELEVATION) * outward + np.sin(_ELEVATION) * up
        right = np.cross(up, outward)
        right /= np.linalg.norm(right)
        rotmat = np.stack([right, np.cross(right, outward), -outward])
        xyz = -rotmat @ (_DISTANCE * outward)
        pose = SE3(quat_from_rotmat(jnp.asarray(rotmat, jnp.float32)), jnp.asarray(xyz, jnp.float32))
        cameras.append(Camera(pose, K, _SIDE, _SIDE))
    return stack_cameras(cameras)
