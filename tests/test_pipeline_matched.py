"""Poses of known templates from matches: sides of a template with photographs, its surface with that of what came."""

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ltgs_jax.features import Classical
from ltgs_jax.geometry import C0, SE3, Camera, rotation_angle, stack_cameras
from ltgs_jax.localize import object_pose
from ltgs_jax.match import Instance
from ltgs_jax.pipeline.config import Config
from ltgs_jax.pipeline.matched import SIDE, Matcher, front_of, pose_from_keypoints, pose_from_surface, surface_of
from ltgs_jax.pipeline.state import State, add_template
from ltgs_jax.register import RegisterConfig
from ltgs_jax.render import render
from ltgs_jax.scene import Splats, Template
from ltgs_jax.template import Crop, Support, TemplateConfig, render_sides

_FLOOR = Support(np.array([0.0, 0, 1]), 0.0, 0.004)
_HALF = np.array([0.12, 0.08, 0.15])
_SIZE = 0.42
_TRUTH = SE3(jnp.asarray([np.cos(1.05), 0, 0, np.sin(1.05)], jnp.float32), jnp.asarray([0.12, 0.07, 0.0]))


@pytest.fixture(scope="module")
def box() -> Splats:
    """A box on the floor with prints on all its sides: cells of random colours."""
    rng = np.random.default_rng(4)
    points, colors = [], []
    for axis in range(3):
        others = [i for i in range(3) if i != axis]
        for sign in (-1.0, 1.0):
            steps = [np.linspace(-1, 1, round(78 * _HALF[i])) for i in others]
            grid = np.stack(np.meshgrid(*steps, indexing="ij"), axis=-1).reshape(-1, 2)
            face = np.empty((len(grid), 3))
            face[:, axis], face[:, others] = sign, grid
            cells = np.floor((grid + 1) * 1.99).astype(int)
            points.append(face * _HALF + [0, 0, _HALF[2]])
            colors.append(rng.random((4, 4, 3))[cells[:, 0], cells[:, 1]])
    points, colors = np.concatenate(points), np.concatenate(colors)
    sh = ((colors - 0.5) / C0)[:, None].astype(np.float32)
    n = len(points)
    quats = np.tile(np.float32([1, 0, 0, 0]), (n, 1))
    scales = np.full((n, 3), np.log(0.011), np.float32)
    return Splats(points.astype(np.float32), quats, scales, np.full(n, 4.0, np.float32), sh)


def _window(splats: Splats, size: int) -> Crop:
    """Windows of three photographs of splats from around, before grey."""
    cameras, target = [], np.array([0.1, 0.1, 0.12])
    for angle in (0.3, 2.4, 4.5):
        eye = np.array([2 * np.cos(angle), 2 * np.sin(angle), 1.1])
        ahead = (target - eye) / np.linalg.norm(target - eye)
        right = np.cross(ahead, [0, 0, 1])
        right /= np.linalg.norm(right)
        matrix = np.eye(4)
        matrix[:3, :3] = np.stack([right, np.cross(ahead, right), ahead])
        matrix[:3, 3] = -matrix[:3, :3] @ eye
        K = jnp.asarray([[3.2 * size, 0, size / 2], [0, 3.2 * size, size / 2], [0, 0, 1]], jnp.float32)
        cameras.append(Camera(SE3.from_matrix(jnp.asarray(matrix, jnp.float32)), K, size, size))
    batch = stack_cameras(cameras)
    out = render(splats, batch, background=jnp.full(3, 0.5))
    backdrop, depth = jnp.full_like(out.image, 0.5), jnp.full_like(out.alpha, 50.0)
    return Crop(batch, jnp.clip(out.image, 0, 1), backdrop, depth, jnp.ones(out.alpha.shape, bool), out.alpha > 0.3)


def _moved(splats: Splats, pose: SE3) -> Splats:
    return eqx.tree_at(lambda s: s.means, splats, np.asarray(pose.apply(jnp.asarray(splats.means))))


def _off(pose: SE3) -> tuple[float, float]:
    """Degrees, and sizes at the middle of the box."""
    middle = jnp.asarray([[0, 0, _HALF[2]]], jnp.float32)
    turn = rotation_angle((pose.inverse() @ _TRUTH).quat)
    return float(np.degrees(turn)), float(jnp.linalg.norm(pose.apply(middle) - _TRUTH.apply(middle)) / _SIZE)


@pytest.fixture(scope="module")
def window(box):
    return _window(_moved(box, _TRUTH), SIDE)


@pytest.fixture(scope="module")
def known(box):
    return surface_of(render_sides(box, _FLOOR, size=_SIZE, side=SIDE), Classical(), size=_SIZE, dense=True)


def test_sides_show_the_surface_where_it_is(box):
    sides = render_sides(box, _FLOOR, size=_SIZE, side=SIDE)
    assert sides.images.shape == (16, SIDE, SIDE, 3) and sides.firm.any(axis=(1, 2)).all()
    points = sides.points[sides.firm]
    inside = np.abs(points - [0, 0, _HALF[2]]) / _HALF
    assert np.quantile(np.abs(inside.max(axis=1) - 1), 0.9) < 0.3  # on a face, less the thickness of a splat
    assert {tuple(row) for row in np.argwhere(inside > 0.97)[:, 1:]} == {(0,), (1,), (2,)}  # on faces of all kinds
    np.testing.assert_allclose(sides.images[~sides.firm & (np.abs(sides.points).max(axis=-1) < 1e-9)], 0.5, atol=0.3)


def test_keypoints_of_all_sides_and_photographs_place_a_printed_box(known, window):
    turn, shift = _off(pose_from_keypoints(known, window, Classical()))
    assert turn < 4 and shift < 0.03
    again = pose_from_keypoints(known, window, Classical())
    np.testing.assert_array_equal(again.xyz, pose_from_keypoints(known, window, Classical()).xyz)


def test_a_plain_thing_has_no_pose_by_keypoints(known, window):
    plain = eqx.tree_at(lambda w: w.target, window, jnp.full_like(window.target, 0.4))
    assert pose_from_keypoints(known, plain, Classical()) is None


def test_surfaces_registered_come_near_where_outlines_bound_them_well(known, window):
    rng = np.random.default_rng(2)
    volume = rng.uniform(-1, 1, (20000, 3)) * _HALF + [0, 0, _HALF[2]]
    instance = Instance(np.asarray(_TRUTH.apply(jnp.asarray(volume, jnp.float32))), tuple(window.region), 3)
    turn, shift = _off(pose_from_surface(known, window, instance, Classical(), RegisterConfig()))
    assert turn < 12 and shift < 0.1


def test_the_front_of_a_volume_is_what_lies_nearest(window):
    rng = np.random.default_rng(2)
    volume = rng.uniform(-1, 1, (20000, 3)) * _HALF + [0, 0, _HALF[2]]
    surface, shown = front_of(volume, window.camera)
    for v in range(3):
        center = np.asarray(window.camera.center())[v]
        far = np.linalg.norm(volume - center, axis=1).mean()
        assert np.median(np.linalg.norm(surface[v][shown[v]] - center, axis=1)) < far
        assert shown[v].sum() > 500


def test_each_kind_of_matches_proposes_a_pose_where_it_is_asked_for(box, window):
    state = State.of_initial(box[:10], np.zeros(10, np.float32), ("a", "b"))
    state = add_template(state, Template(box, 1, 0), np.zeros(box.count, np.float32), _FLOOR, 0)
    instance = Instance(np.asarray(_TRUTH.apply(jnp.asarray(box.means))), tuple(window.region), 3)
    asked = {"matches": False, "registration": False}
    for kinds in ((), ("matches",), ("registration",), ("matches", "registration")):
        config = replace(Config(), template=TemplateConfig(**{**asked, **dict.fromkeys(kinds, True)}))
        found = Matcher(state, Classical(), config).poses(0, window, instance)
        assert tuple(found) == kinds
        assert all(_off(pose)[0] < 15 for pose in found.values())


def test_what_stood_on_nothing_known_is_not_matched(box, window):
    state = State.of_initial(box[:10], np.zeros(10, np.float32), ("a", "b"))
    state = add_template(state, Template(box, 1, 0), np.zeros(box.count, np.float32), None, 0)
    assert Matcher(state, Classical(), Config()).poses(0, window, Instance(np.zeros((4, 3)), (), 3)) == {}


@pytest.mark.parametrize("wrong", [0, 20, 40])
def test_an_object_has_one_pose_in_all_views(window, wrong):
    rng = np.random.default_rng(wrong)
    points = rng.uniform(-1, 1, (60, 3)) * _HALF
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_rotvec([0.4, 1.0, -0.3]).as_matrix(), [0.1, 0.1, 0.12]
    view = np.arange(60) % 3
    cameras = np.asarray(window.camera.cam_from_world.as_matrix(), np.float64)[:, :3]
    K = np.asarray(window.camera.K, np.float64)
    local = np.einsum("nij,nj->ni", cameras[view], np.c_[points @ pose[:3, :3].T + pose[:3, 3], np.ones(60)])
    xy = np.einsum("nij,nj->ni", K[view], local)
    xy = xy[:, :2] / xy[:, 2:] + rng.normal(scale=0.3, size=(60, 2))
    xy[:wrong] = rng.uniform(0, SIDE, (wrong, 2))
    found, agreed = object_pose(xy, points, view, cameras, K, size=SIDE, max_error=3.0)
    assert agreed[wrong:].mean() > 0.9 and agreed[:wrong].sum() <= 3
    turn = Rotation.from_matrix(found[:, :3] @ pose[:3, :3].T).magnitude()
    assert np.degrees(turn) < 2 and np.linalg.norm(found[:, 3] - pose[:3, 3]) < 0.005
    assert object_pose(xy[:3], points[:3], view[:3], cameras, K, size=SIDE, max_error=3.0) is None
