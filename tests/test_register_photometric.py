"""Pose from pixels: derivatives, convergence from afar, and failures that say so."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from register_problems import angle, surface

from ltgs_jax.geometry import SE3, Camera
from ltgs_jax.register.photometric import (
    PhotometricConfig,
    PoseResult,
    Views,
    _Patches,
    cameras_at,
    pixel_residuals,
    refine_pose,
)
from ltgs_jax.render import RenderConfig, plan_render, render
from ltgs_jax.scene import Splats

SIDE, VIEWS, SIZE = 64, 2, 1.0
REACH = 0.05


def textured_object(count: int = 240, dtype=np.float32) -> Splats:
    """A lopsided closed surface in coarse random colours, off the origin of its frame."""
    rng = np.random.default_rng(0)
    points = surface(rng, count)
    colors = 0.5 + 0.5 * np.sin(points @ rng.normal(0, 9, (3, 3)) + rng.uniform(0, 6, 3))
    fields = (
        points + np.array([2.0, -1.0, 0.5]),
        rng.normal(size=(count, 4)),
        np.log(rng.uniform(0.03, 0.06, (count, 3))),
        np.full(count, 3.0),
        (colors[:, None] - 0.5) / 0.28209479,
    )
    return Splats(*(jnp.asarray(field, dtype) for field in fields))


def looking(eyes: np.ndarray, dtype=np.float32) -> Camera:
    """Cameras at `eyes` that look at the origin."""
    rotmats = []
    for eye in eyes:
        z = -eye / np.linalg.norm(eye)
        x = np.cross(z, [0, 0, 1.0])
        x /= np.linalg.norm(x)
        rotmats.append(np.stack([x, np.cross(z, x), z]))
    rotmat = np.stack(rotmats)
    matrix = np.tile(np.eye(4), (len(eyes), 1, 1))
    matrix[:, :3, :3], matrix[:, :3, 3] = rotmat, -np.einsum("nij,nj->ni", rotmat, eyes)
    K = np.tile([[90.0, 0, SIDE / 2], [0, 90.0, SIDE / 2], [0, 0, 1]], (len(eyes), 1, 1))
    return Camera(SE3.from_matrix(jnp.asarray(matrix, dtype)), jnp.asarray(K, dtype), SIDE, SIDE)


def truth(dtype=np.float32) -> SE3:
    """world_from_template that puts the object's middle at the world's origin."""
    turn = SE3.exp(jnp.asarray([0, 0, 0, 0.3, -0.5, 0.9], dtype))
    return SE3(turn.quat, -turn.apply(jnp.asarray([[2.0, -1.0, 0.5]], dtype))[0])


@pytest.fixture(scope="module")
def scene() -> tuple[Splats, Views]:
    """The object before a textured backdrop, seen from two sides."""
    template = textured_object()
    cameras = looking(np.array([[1.9, 0.4, 0.8], [0.2, 1.8, 1.0]]))
    out = render(template, cameras_at(cameras, truth().__getitem__(None)))
    rows, columns = np.mgrid[:SIDE, :SIDE] / SIDE
    backdrop = np.stack([0.5 + 0.3 * np.sin(9 * rows), 0.4 + 0.2 * columns, 0.5 + 0.2 * np.cos(7 * columns)], -1)
    backdrop = jnp.asarray(np.broadcast_to(backdrop, (VIEWS, SIDE, SIDE, 3)), jnp.float32)
    target = out.image + (1 - out.alpha)[..., None] * backdrop
    return template, Views(cameras, target, backdrop, jnp.zeros((VIEWS, SIDE, SIDE)), jnp.ones_like(out.alpha, bool))


def moved(tangents) -> SE3:
    """The truth, turned and shifted about the object's middle (v, ω); one start per row."""
    world = SE3.exp(jnp.asarray(tangents, jnp.float32))
    return world @ truth()


def errors(poses: SE3, template: Splats) -> tuple[np.ndarray, np.ndarray]:
    """Degrees, and displacement of the middle in shares of the size, of each pose."""
    exact = np.asarray(truth().rotmat(), np.float64)
    middle = jnp.mean(template.means, axis=0)[None]
    angles = [angle(poses[i], exact) for i in range(poses.xyz.shape[0])]
    shift = np.linalg.norm(np.asarray(poses.apply(middle) - truth().apply(middle)), axis=-1)[:, 0]
    return np.array(angles), shift / SIZE


STARTS = np.array(
    [
        [0.05, 0, 0, 0.0873, 0, 0],
        [0, -0.05, 0, 0, 0.0617, 0.0617],
        [-0.03, 0.02, 0.035, -0.05, -0.05, 0.05],
        [0, 0, 0, 0, 0, 0],
    ]
)


@pytest.mark.slow
def test_starts_five_degrees_and_a_twentieth_of_the_size_off_converge(scene):
    template, views = scene
    fit = refine_pose(template, moved(STARTS), views, size=SIZE, reach=REACH)
    angles, shifts = errors(fit.poses, template)
    assert np.all(np.asarray(fit.result) == PoseResult.SUCCESS)
    assert angles.max() < 0.2
    assert shifts.max() < 0.002
    assert np.all(np.asarray(fit.cost)[:3] < 0.05 * np.asarray(fit.start_cost)[:3])
    assert np.all(np.asarray(fit.steps) <= PhotometricConfig().steps + 1)


@pytest.mark.slow
def test_failures_say_so(scene):
    """Far beside, beside the image, and where nothing counts: never a success, never a worse pose."""
    template, views = scene
    starts = moved([[0.9, 0.9, 0, 2.0, 0, 0], [40.0, 0, 0, 0, 0, 0], [0, 0, 0.02, 0, 0, 0], [0, 0, 0, 0, 0, 0]])
    fit = refine_pose(template, starts, views, size=SIZE, reach=REACH)
    results = [PoseResult(int(code)) for code in fit.result]
    assert results[0] in (PoseResult.NO_GAIN, PoseResult.NOT_CONVERGED, PoseResult.DIVERGED, PoseResult.OUT_OF_VIEW)
    assert results[1] == PoseResult.OUT_OF_VIEW
    assert results[2:] == [PoseResult.SUCCESS] * 2
    assert "object" in results[1].reason
    for leaf in jax.tree.leaves(fit):
        assert np.isfinite(np.asarray(leaf)).all()
    assert np.all(np.asarray(fit.cost) <= np.asarray(fit.start_cost) * 1.001)


def test_what_stands_in_front_and_pixels_that_do_not_count_are_left_out(scene):
    """Half of a view behind a nearer surface, a quarter marked as not to be used: both garbled, neither matters."""
    template, views = scene
    near = views.depth.at[0, :, : SIDE // 2].set(0.2)
    hidden = jnp.where((near > 0)[..., None], views.backdrop, views.target)
    valid = views.valid.at[1, : SIDE // 2].set(False)
    garbled = jnp.where(valid[..., None], hidden, 0.0)
    fit = refine_pose(
        template, moved(STARTS), Views(views.camera, garbled, views.backdrop, near, valid), size=SIZE, reach=REACH
    )
    angles, shifts = errors(fit.poses, template)
    assert np.all(np.asarray(fit.result) == PoseResult.SUCCESS)
    assert angles.max() < 0.5
    assert shifts.max() < 0.005


def test_residuals_derive_like_finite_differences():
    """The forward-mode Jacobian by the six tangent directions, in float64, pixel by pixel."""
    with jax.enable_x64(True):
        template = textured_object(60, np.float64)
        cameras = looking(np.array([[1.9, 0.4, 0.8]]), np.float64)
        tiles = jnp.arange(64, dtype=jnp.int32)[None]
        blank = jnp.zeros((1, 64, 8, 8), jnp.float64)
        patches = _Patches(cameras, tiles, blank[..., None] + jnp.zeros(3), blank[..., None] + 0.3, blank, blank == 0)
        start = truth(np.float64)[None]
        plan = plan_render(template, cameras_at(cameras, start), slack=1.5)

        @jax.jit
        def residuals(tangent):
            pose = start @ SE3.exp(tangent)
            return pixel_residuals(template, pose, patches, jnp.asarray(REACH), plan, RenderConfig())[0].ravel()

        still = jnp.zeros((1, 6), jnp.float64)
        for lane in range(6):
            direction = still.at[0, lane].set(1)
            _, forward = jax.jvp(residuals, (still,), (direction,))
            step = 1e-6
            difference = (residuals(step * direction) - residuals(-step * direction)) / (2 * step)
            gap = np.abs(np.asarray(forward - difference))
            assert np.abs(forward).max() > 0.1
            # A pixel in which a splat crosses α = 1/255 within the step has no derivative.
            assert np.quantile(gap, 0.995) < 1e-5


@pytest.mark.parametrize(
    ("name", "change"),
    [("views.target", {"target": jnp.zeros((1, 4, 4, 3))}), ("views.valid", {"valid": jnp.zeros((2, 9, 9), bool)})],
)
def test_wrong_shapes_are_named(scene, name, change):
    template, views = scene
    fields = {"camera": views.camera, "target": views.target, "backdrop": views.backdrop, "depth": views.depth}
    with pytest.raises(ValueError, match=name):
        refine_pose(
            template, moved(STARTS), Views(**{**fields, "valid": views.valid, **change}), size=SIZE, reach=REACH
        )
