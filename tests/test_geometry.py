"""Rigid motions, spherical harmonics, cameras."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ltgs_jax.geometry import (
    SE3,
    Camera,
    normalize_quats,
    quat_from_rotmat,
    rotate_sh,
    rotation_angle,
    rotmat_from_quat,
    sh_basis,
    sh_rotations,
)


def _random_se3(seed: int) -> SE3:
    rng = np.random.default_rng(seed)
    return SE3(jnp.asarray(rng.normal(size=4)), jnp.asarray(rng.normal(size=3)))


def test_quaternions_agree_with_scipy():
    rng = np.random.default_rng(0)
    quats = rng.normal(size=(100, 4))
    expected = Rotation.from_quat(quats[:, [1, 2, 3, 0]]).as_matrix()
    with jax.enable_x64(True):
        rotmats = rotmat_from_quat(jnp.asarray(quats))
        np.testing.assert_allclose(rotmats, expected, atol=1e-14)
        back = rotmat_from_quat(quat_from_rotmat(rotmats))
        np.testing.assert_allclose(back, expected, atol=1e-14)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_quat_from_rotmat_at_half_turns(axis):
    with jax.enable_x64(True):
        half_turn = -np.eye(3)
        half_turn[axis, axis] = 1
        np.testing.assert_allclose(rotmat_from_quat(quat_from_rotmat(jnp.asarray(half_turn))), half_turn, atol=1e-15)


def test_zero_quaternion_is_identity_with_finite_gradient():
    zero = jnp.zeros(4)
    np.testing.assert_array_equal(rotmat_from_quat(zero), np.eye(3))
    assert np.isfinite(jax.jacobian(rotmat_from_quat)(zero)).all()


@pytest.mark.parametrize("scale", [1e-30, 1e30])
def test_quaternions_of_any_length(scale):
    quat = jnp.asarray([0.3, -0.2, 0.5, 0.7], jnp.float32)
    np.testing.assert_allclose(normalize_quats(quat * scale), normalize_quats(quat), rtol=1e-6)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, 1.0, 3.0, np.pi])
def test_exp_agrees_with_the_matrix_exponential(angle):
    with jax.enable_x64(True):
        omega = angle * np.array([2.0, -1.0, 2.0]) / 3
        v = np.array([0.3, -0.2, 0.1])
        generator = np.zeros((4, 4))
        generator[:3, :3] = [[0, -omega[2], omega[1]], [omega[2], 0, -omega[0]], [-omega[1], omega[0], 0]]
        generator[:3, 3] = v
        motion = SE3.exp(jnp.asarray(np.concatenate([v, omega])))
        np.testing.assert_allclose(motion.as_matrix(), jax.scipy.linalg.expm(generator), atol=1e-12)
        np.testing.assert_allclose(rotation_angle(motion.quat), angle, atol=1e-12)


def test_exp_is_smooth_at_zero():
    with jax.enable_x64(True):
        jacobian = jax.jacobian(lambda xi: SE3.exp(xi).as_matrix())(jnp.zeros(6))
        step = 1e-6
        for lane in range(6):
            xi = jnp.zeros(6).at[lane].set(step)
            difference = (SE3.exp(xi).as_matrix() - SE3.exp(-xi).as_matrix()) / (2 * step)
            np.testing.assert_allclose(jacobian[..., lane], difference, atol=1e-9)


def test_group_laws():
    with jax.enable_x64(True):
        a, b = _random_se3(1), _random_se3(2)
        points = jnp.asarray(np.random.default_rng(3).normal(size=(7, 3)))
        np.testing.assert_allclose((a @ b).apply(points), a.apply(b.apply(points)), atol=1e-13)
        np.testing.assert_allclose((a @ a.inverse()).as_matrix(), np.eye(4), atol=1e-13)
        np.testing.assert_allclose(SE3.from_matrix(a.as_matrix()).apply(points), a.apply(points), atol=1e-13)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_rotated_sh_is_the_rotated_function(degree):
    with jax.enable_x64(True):
        rng = np.random.default_rng(4)
        rotmat = rotmat_from_quat(jnp.asarray(rng.normal(size=4)))
        sh = jnp.asarray(rng.normal(size=(5, (degree + 1) ** 2, 3)))
        directions = rng.normal(size=(11, 3))
        directions = jnp.asarray(directions / np.linalg.norm(directions, axis=1, keepdims=True))
        rotated = jnp.einsum("dk,nkc->ndc", sh_basis(directions, degree), rotate_sh(sh, sh_rotations(rotmat, degree)))
        expected = jnp.einsum("dk,nkc->ndc", sh_basis(directions @ rotmat, degree), sh)
        np.testing.assert_allclose(rotated, expected, atol=1e-13)


def test_sh_basis_is_orthonormal():
    with jax.enable_x64(True):
        nodes, weights = np.polynomial.legendre.leggauss(8)
        phi = np.arange(16) * np.pi / 8
        z, phi = np.meshgrid(nodes, phi, indexing="ij")
        radius = np.sqrt(1 - z**2)
        directions = np.stack([radius * np.cos(phi), radius * np.sin(phi), z], axis=-1).reshape(-1, 3)
        area = np.repeat(weights, 16) * np.pi / 8
        basis = np.asarray(sh_basis(jnp.asarray(directions), 3))
        np.testing.assert_allclose(basis.T @ (basis * area[:, None]), np.eye(16), atol=1e-12)


def test_camera_projects_and_unprojects():
    with jax.enable_x64(True):
        K = jnp.asarray([[200.0, 0, 80], [0, 210, 60], [0, 0, 1]])
        camera = Camera(_random_se3(5), K, 160, 120)
        pixels = jnp.asarray([[0.5, 0.5], [80.0, 60.0], [159.5, 119.5]])
        depths = jnp.asarray([1.0, 2.0, 3.0])
        back, z = camera.project(camera.unproject(pixels, depths))
        np.testing.assert_allclose(back, pixels, atol=1e-11)
        np.testing.assert_allclose(z, depths, atol=1e-12)
        centre, directions = camera.rays(pixels)
        on_rays = centre + directions * 2.5
        np.testing.assert_allclose(camera.project(on_rays)[0], pixels, atol=1e-11)
        half = camera.resized(80, 60)
        np.testing.assert_allclose(half.project(on_rays)[0], pixels / 2, atol=1e-11)
