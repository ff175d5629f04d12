"""Alignment with renders: a photograph too blurred for features, against a ray-cast scene with known depth."""

import cv2
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from ltgs_jax.geometry import SE3, Camera
from ltgs_jax.localize import align_photograph, correct_pose

_K = np.array([[150.0, 0, 80], [0, 150, 60], [0, 0, 1]])
_SHAPE = (120, 160)


def _texture():
    rng = np.random.default_rng(0)
    image = np.zeros((512, 512), np.float32)
    for sigma in (3, 10, 30, 60):
        octave = cv2.GaussianBlur(rng.standard_normal(image.shape).astype(np.float32), (0, 0), sigma)
        image += octave / octave.std()
    return np.clip(0.5 + 0.12 * image, 0, 1)


_TEXTURE = _texture()


def _bumpy_plane(camera):
    """Image, depth and alpha of the plane z = 0, |x|, |y| < 2, and of a second one half a unit above its middle."""
    pose = np.asarray(camera.cam_from_world.as_matrix(), np.float64)[:3]
    K = np.asarray(camera.K, np.float64)
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    rays = np.stack([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], np.ones_like(x)], axis=-1) @ pose[:, :3]
    center = -pose[:, :3].T @ pose[:, 3]
    image, depth = np.zeros((*x.shape, 3), np.float32), np.full(x.shape, np.inf)
    for level, half, shift in ((0.0, 2.0, 0.0), (0.5, 0.6, 1.0)):
        distance = (level - center[2]) / rays[..., 2]
        at = center + distance[..., None] * rays
        on = (distance > 0) & (distance < depth) & (np.abs(at[..., 0]) < half) & (np.abs(at[..., 1]) < half)
        u, v = ((at[..., i] + shift + 2) * 128 - 0.5 for i in (0, 1))
        colour = cv2.remap(_TEXTURE, u.astype(np.float32) % 512, v.astype(np.float32) % 512, cv2.INTER_LINEAR)
        image[on], depth[on] = colour[on][:, None], distance[on]
    covered = np.isfinite(depth)
    return image, np.where(covered, depth, 0), covered.astype(np.float32)


def _pose():
    rotation = Rotation.from_euler("xyz", [150, 8, 20], degrees=True).as_matrix()
    return np.concatenate([rotation, -rotation @ np.array([[0.2], [-1.3], [2.4]])], axis=1)


def _photograph():
    matrix = np.concatenate([_pose(), [[0.0, 0, 0, 1]]]).astype(np.float32)
    camera = Camera(SE3.from_matrix(jnp.asarray(matrix)), jnp.asarray(_K, jnp.float32), _SHAPE[1], _SHAPE[0])
    sharp = _bumpy_plane(camera)[0]
    # Another exposure, and a blur that leaves SIFT nothing.
    return cv2.GaussianBlur(0.6 * sharp + 0.05, (0, 0), 1.5)


def _errors(pose):
    turn = Rotation.from_matrix(pose[:, :3] @ _pose()[:, :3].T).magnitude()
    place = -pose[:, :3].T @ pose[:, 3] + _pose()[:, :3].T @ _pose()[:, 3]
    return np.degrees(turn), np.linalg.norm(place)


def _off(degrees, distance):
    """The true pose, turned and moved."""
    rotation = Rotation.from_rotvec(np.radians(degrees) * np.array([0.48, -0.6, 0.64])).as_matrix()
    moved = rotation @ _pose()
    moved[:, 3] += distance * np.array([0.6, -0.64, 0.48])
    return moved


def test_alignment_converges_from_the_best_of_several_guesses():
    image, far = _photograph(), _off(60, 1.0)
    found = align_photograph(image, _K, [far, _off(5, 0.15)], _bumpy_plane)
    degrees, distance = _errors(found.cam_from_world)
    assert degrees < 0.5 and distance < 0.04
    assert found.agreeing > 0.9 * found.textured > 20
    assert found.correlation > 0.9


def test_alignment_of_another_place_does_not_agree():
    other = np.repeat(cv2.resize(_TEXTURE[::-1, ::-1].T[:300, :400], _SHAPE[::-1])[..., None], 3, axis=-1)
    found = align_photograph(np.ascontiguousarray(other), _K, [_pose()], _bumpy_plane)
    assert found.agreeing < 0.5 * found.textured
    assert align_photograph(other, _K, [], _bumpy_plane) is None


def test_a_rough_pose_is_mended():
    found = correct_pose(_photograph(), _K, _off(1.5, 0.03), _bumpy_plane)
    degrees, distance = _errors(found.cam_from_world)
    assert degrees < 0.3 and distance < 0.02


def test_a_right_pose_stays():
    assert correct_pose(_photograph(), _K, _off(0.05, 0.002), _bumpy_plane) is None


def test_a_pose_is_kept_where_nothing_agrees():
    other = np.ascontiguousarray(np.flipud(np.fliplr(_photograph())))
    assert correct_pose(other, _K, _pose(), _bumpy_plane) is None
