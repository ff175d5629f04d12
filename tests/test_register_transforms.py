"""`register` under jit, vmap, grad and in double precision."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from register_problems import motion, problem

from ltgs_jax.geometry import SE3
from ltgs_jax.register import register
from ltgs_jax.register.align import align, alignment_moments
from ltgs_jax.register.hypotheses import BLOCK, Problem, search
from ltgs_jax.register.outcome import Effort, RegisterConfig


@pytest.mark.slow
def test_a_batch_gives_the_answers_of_its_problems():
    """Under jit and vmap, problems of different difficulty in one call."""
    cases = [problem(seed, 100, outliers) for seed, outliers in ((1, 0.0), (2, 0.6), (3, 0.85))]
    src, dst = (jnp.asarray(np.stack([case[i] for case in cases]), jnp.float32) for i in (0, 1))
    batch = jax.jit(jax.vmap(lambda a, b: register(a, b, noise_bound=0.017)))(src, dst)
    for index, case in enumerate(cases):
        alone = register(case[0], case[1], noise_bound=0.017)
        expected = np.asarray(alone.dst_from_src.as_matrix())
        np.testing.assert_allclose(batch.dst_from_src[index].as_matrix(), expected, atol=1e-4)
        assert int(batch.result[index]) == int(alone.result)


def test_gradients_by_the_points_match_finite_differences():
    """Implicit derivatives through the robust optimum, outliers included, in float64."""
    with jax.enable_x64(True):
        src, dst, *_ = problem(5, 24, 0.25, sigma=0.02)
        rng = np.random.default_rng(6)
        probe = SE3(jnp.asarray(rng.normal(size=4)), jnp.asarray(rng.normal(size=3)))

        @jax.jit
        @jax.value_and_grad
        def loss(points):
            found = register(points[0], points[1], noise_bound=0.07).dst_from_src
            return jnp.sum(found.rotmat() * probe.rotmat()) + found.xyz @ probe.xyz

        points = np.stack([src, dst])
        value, gradient = loss(jnp.asarray(points))
        assert np.isfinite(value)
        assert np.abs(gradient).max() > 1e-3
        step = 1e-5
        for place in [(0, 1, 2), (0, 20, 0), (1, 3, 1), (1, 11, 2), (0, 15, 1), (1, 23, 0)]:
            ends = []
            for sign in (1, -1):
                moved = points.copy()
                moved[place] += sign * step
                ends.append(float(loss(jnp.asarray(moved))[0]))
            assert abs((ends[0] - ends[1]) / (2 * step) - float(gradient[place])) <= 1e-5


def test_a_common_motion_moves_the_answer_in_double_precision():
    with jax.enable_x64(True):
        src, dst, *_ = problem(19, 50, 0.5)
        common, shift = motion(np.random.default_rng(20))
        plain = register(src, dst, noise_bound=0.017).dst_from_src.as_matrix()
        assert plain.dtype == jnp.float64
        moved = register(src @ common.T + shift, dst @ common.T + shift, noise_bound=0.017)
        change = np.eye(4)
        change[:3, :3], change[:3, 3] = common, shift
        expected = change @ np.asarray(plain) @ np.linalg.inv(change)
        np.testing.assert_allclose(moved.dst_from_src.as_matrix(), expected, atol=1e-10)


def test_alignment_is_the_closed_form_of_scipy():
    from scipy.spatial.transform import Rotation

    rng = np.random.default_rng(7)
    src, dst, *_ = problem(8, 40, 0.5)
    weights = rng.uniform(size=(5, 40))
    moments = alignment_moments(jnp.asarray(src, jnp.float32), jnp.asarray(dst, jnp.float32))
    quats, xyz = align(jnp.asarray(weights, jnp.float32), moments)
    for row in range(5):
        w = weights[row]
        a, b = (np.average(points, axis=0, weights=w) for points in (src, dst))
        rotation, _ = Rotation.align_vectors(dst - b, src - a, weights=w)
        found = np.asarray(SE3(quats[row], xyz[row]).rotmat())
        np.testing.assert_allclose(found, rotation.as_matrix(), atol=2e-3)
        np.testing.assert_allclose(xyz[row], b - rotation.as_matrix() @ a, atol=2e-3)


def test_blocks_of_columns_change_nothing(monkeypatch):
    """The hypotheses of a problem in blocks are those of the whole matrix."""
    src, dst, *_ = problem(9, 256, 0.8)
    whole = Problem(*(jnp.asarray(x, jnp.float32) for x in (src, dst, np.ones(256))), jnp.float32(0.017))
    effort, config = Effort(points=32, pairs=0, finalists=16, bound_factors=(1.0,)), RegisterConfig()
    expected = search(whole, effort, config)
    assert BLOCK > 256
    monkeypatch.setattr("ltgs_jax.register.hypotheses.BLOCK", 64)
    blocked = search(whole, effort, config)
    np.testing.assert_allclose(np.sort(blocked.score), np.sort(expected.score), atol=1e-2)


@pytest.mark.slow
def test_five_thousand_correspondences():
    src, dst, rotmat, *_ = problem(10, 5000, 0.95)
    found = register(src, dst, noise_bound=0.017).dst_from_src
    assert np.abs(np.asarray(found.rotmat()) - rotmat).max() < 0.02
