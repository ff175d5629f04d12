"""Robust registration against known motions and closed forms. Every problem here pads to one compiled size."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from register_problems import angle, motion, problem, surface
from scipy.spatial.transform import Rotation

from ltgs_jax.register import RegisterConfig, Result, register


def assert_proper(answer) -> None:
    """Nothing in the answer is NaN or infinite, and both rotations are rotations."""
    for leaf in jax.tree.leaves(answer):
        assert np.isfinite(np.asarray(leaf)).all()
    for found in (answer.dst_from_src, answer.second):
        rotmat = np.asarray(found.rotmat(), np.float64)
        np.testing.assert_allclose(rotmat @ rotmat.T, np.eye(3), atol=1e-5)
        assert np.linalg.det(rotmat) > 0.999


@pytest.mark.parametrize("outliers", [0.0, 0.5, 0.8, 0.9])
def test_recovers_the_motion_among_outliers(outliers):
    src, dst, rotmat, xyz, inlier = problem(1, 120, outliers)
    answer = register(src, dst, noise_bound=0.017)
    assert int(answer.result) == Result.SUCCESS
    assert angle(answer.dst_from_src, rotmat) < 1.5
    moved = np.asarray(answer.dst_from_src.apply(jnp.asarray(src, jnp.float32)))
    assert np.abs(moved - (src @ rotmat.T + xyz)).max() < 0.02
    weights = np.asarray(answer.inlier_weights)
    assert weights.shape == (120,)
    assert weights[inlier].mean() > 0.85
    assert float(answer.confidence) > 0.95
    assert not bool(answer.ambiguous)
    assert_proper(answer)


@pytest.mark.parametrize("factor", [0.25, 0.5, 2.0, 4.0])
def test_a_wrong_noise_bound_is_survived(factor):
    for seed in range(4):
        src, dst, rotmat, *_ = problem(seed, 120, 0.8)
        answer = register(src, dst, noise_bound=0.017 * factor)
        assert angle(answer.dst_from_src, rotmat) < 5


def test_a_bound_too_wide_is_narrowed_to_the_noise():
    src, dst, rotmat, *_ = problem(12, 120, 0.5)
    answer = register(src, dst, noise_bound=0.017 * 4)
    np.testing.assert_allclose(answer.noise_bound, 0.017, rtol=1e-3)
    assert angle(answer.dst_from_src, rotmat) < 0.5


def test_least_squares_limit_is_kabsch():
    """Without outliers and far under the bound, the robust optimum is the closed-form least squares on the inliers."""
    src, dst, *_ = problem(2, 120, 0.0)
    answer = register(src, dst, noise_bound=0.02)
    rotation, _ = Rotation.align_vectors(dst - dst.mean(0), src - src.mean(0))
    assert angle(answer.dst_from_src, rotation.as_matrix()) < 0.05
    expected = dst.mean(0) - rotation.as_matrix() @ src.mean(0)
    np.testing.assert_allclose(answer.dst_from_src.xyz, expected, atol=3e-4)


def test_covariance_predicts_the_spread_of_the_answers():
    """Over repeated noise the tangent errors have the covariance that each answer states."""
    rng = np.random.default_rng(13)
    src, sigma = surface(rng, 100) + np.array([0.5, 0.2, -0.3]), 0.01
    rotmat, xyz = motion(rng)
    errors, stated = [], []
    for _ in range(60):
        dst = src @ rotmat.T + xyz + sigma * rng.normal(size=src.shape)
        answer = register(src, dst, noise_bound=3.37 * sigma)
        local = rotmat.T @ np.asarray(answer.dst_from_src.rotmat(), np.float64)
        shift = rotmat.T @ (np.asarray(answer.dst_from_src.xyz, np.float64) - xyz)
        errors.append(np.r_[shift, Rotation.from_matrix(local).as_rotvec()])
        stated.append(np.asarray(answer.covariance))
    whitened = np.linalg.solve(np.linalg.cholesky(np.mean(stated, axis=0).astype(np.float64)), np.array(errors).T)
    # χ² with 360 degrees of freedom: 4 standard deviations are ±0.3.
    assert 0.7 < np.mean(whitened**2) < 1.3


def test_weights_of_zero_and_nan_rows_are_absent():
    src, dst, rotmat, *_ = problem(3, 120, 0.5)
    src[:10] = np.nan
    dst[10:20] = 1e6
    weights = np.ones(120)
    weights[10:20] = 0
    answer = register(src, dst, noise_bound=0.017, weights=weights)
    assert int(answer.result) == Result.SUCCESS
    assert angle(answer.dst_from_src, rotmat) < 1.5
    assert np.all(np.asarray(answer.inlier_weights)[:20] == 0)


@pytest.mark.parametrize("count", [65, 100, 128])
def test_padding_changes_nothing(count):
    """Rows of weight 0 and rows that are not there are the same."""
    src, dst, *_ = problem(14, 65, 0.3)
    more = np.r_[src, np.full((count - 65, 3), 7.0)]
    weights = np.r_[np.ones(65), np.zeros(count - 65)]
    plain = register(src, dst, noise_bound=0.017)
    padded = register(more, np.r_[dst, np.zeros((count - 65, 3))], noise_bound=0.017, weights=weights)
    np.testing.assert_allclose(plain.dst_from_src.as_matrix(), padded.dst_from_src.as_matrix(), atol=1e-6)


def _few(count):
    """`count` usable correspondences in arrays of one compiled size."""
    points = np.full((100, 3), np.nan)
    points[:count] = np.eye(3)[:count]
    return points


@pytest.mark.parametrize("count", [0, 1, 2])
def test_fewer_than_three_usable_points_are_a_failure_with_its_reason(count):
    answer = register(_few(count), _few(count), noise_bound=0.1)
    assert int(answer.result) == Result.TOO_FEW_POINTS
    assert float(answer.confidence) == 0
    assert "fewer than 3" in Result(int(answer.result)).reason
    assert_proper(answer)


def test_no_consensus_is_a_failure():
    rng = np.random.default_rng(4)
    answer = register(surface(rng, 100), surface(rng, 100), noise_bound=0.017)
    assert int(answer.result) == Result.NO_CONSENSUS
    assert float(answer.confidence) < 0.5
    assert_proper(answer)


def test_points_that_coincide_are_no_consensus():
    answer = register(np.ones((100, 3)), np.ones((100, 3)), noise_bound=0.01)
    assert int(answer.result) == Result.NO_CONSENSUS
    assert_proper(answer)


@pytest.mark.parametrize("radius", [0.0, 0.02], ids=["line", "rod"])
@pytest.mark.parametrize("outliers", [0, 60])
def test_a_line_of_inliers_names_its_axis(radius, outliers):
    rng = np.random.default_rng(5)
    axis = np.array([0.6, 0.0, 0.8])
    turn = rng.uniform(0, 2 * np.pi, 100)
    ring = np.cos(turn)[:, None] * np.array([0, 1, 0]) + np.sin(turn)[:, None] * np.array([0.8, 0, -0.6])
    src = rng.uniform(-0.5, 0.5, 100)[:, None] * axis + radius * ring
    src[:outliers] = surface(rng, outliers)
    rotmat, xyz = motion(rng)
    dst = src @ rotmat.T + xyz + 0.005 * rng.normal(size=src.shape)
    dst[:outliers] = surface(rng, outliers) + xyz
    answer = register(src, dst, noise_bound=0.017)
    assert int(answer.result) == Result.SUCCESS
    assert bool(answer.ambiguous)
    assert abs(np.asarray(answer.ambiguous_axis) @ axis) > 0.999
    assert np.asarray(answer.dst_from_src.rotmat()) @ axis @ (rotmat @ axis) > 0.999
    middle = np.asarray(answer.dst_from_src.apply(jnp.zeros((1, 3), jnp.float32)))[0]
    np.testing.assert_allclose(middle, xyz, atol=0.01)
    assert_proper(answer)


def test_a_plane_of_inliers_is_no_reflection():
    rng = np.random.default_rng(15)
    src = np.c_[rng.uniform(-0.5, 0.5, (100, 2)), np.zeros(100)]
    rotmat, xyz = motion(rng)
    dst = src @ rotmat.T + xyz + 0.005 * rng.normal(size=src.shape)
    answer = register(src, dst, noise_bound=0.017)
    assert angle(answer.dst_from_src, rotmat) < 1
    assert not bool(answer.ambiguous)
    assert_proper(answer)


def test_a_mirrored_object_is_not_matched_by_a_reflection():
    rng = np.random.default_rng(16)
    src = surface(rng, 100)
    assert_proper(register(src, src * np.array([-1, 1, 1]), noise_bound=0.017))


@pytest.mark.parametrize("factor", [1.0, 0.25])
def test_the_larger_of_two_motions_wins_and_the_second_is_reported(factor):
    rng = np.random.default_rng(6)
    src = surface(rng, 120)
    (first, t1), (second, t2) = motion(rng), motion(rng)
    dst = np.where(np.arange(120)[:, None] < 70, src @ first.T + t1, src @ second.T + t2)
    answer = register(src, dst + 0.003 * rng.normal(size=src.shape), noise_bound=0.01 * factor)
    assert angle(answer.dst_from_src, first) < 3
    if factor == 1:
        assert angle(answer.second, second) < 1
        assert 30 <= int(answer.second_inliers) <= 55


def test_one_motion_has_no_second():
    src, dst, *_ = problem(17, 120, 0.5)
    assert int(register(src, dst, noise_bound=0.017).second_inliers) == 0


def test_answers_are_deterministic():
    src, dst, *_ = problem(18, 120, 0.9)
    a, b = (register(src, dst, noise_bound=0.017, key=jax.random.key(3)) for _ in range(2))
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_array_equal(x, y)


def test_a_common_motion_moves_the_answer():
    src, dst, *_ = problem(19, 120, 0.5)
    common, shift = motion(np.random.default_rng(20))
    plain = np.asarray(register(src, dst, noise_bound=0.017).dst_from_src.as_matrix(), np.float64)
    moved = register(src @ common.T + shift, dst @ common.T + shift, noise_bound=0.017)
    change = np.eye(4)
    change[:3, :3], change[:3, 3] = common, shift
    expected = change @ plain @ np.linalg.inv(change)
    np.testing.assert_allclose(moved.dst_from_src.as_matrix(), expected, atol=1e-5)


@pytest.mark.parametrize("unit", [1e-3, 1e3])
def test_a_change_of_unit_changes_the_unit_of_the_answer(unit):
    src, dst, *_ = problem(21, 120, 0.8)
    plain = register(src, dst, noise_bound=0.017)
    scaled = register(src * unit, dst * unit, noise_bound=0.017 * unit)
    np.testing.assert_allclose(plain.dst_from_src.rotmat(), scaled.dst_from_src.rotmat(), atol=2e-5)
    np.testing.assert_allclose(plain.dst_from_src.xyz, scaled.dst_from_src.xyz / unit, atol=2e-5)
    np.testing.assert_allclose(plain.residual, scaled.residual / unit, rtol=1e-3)


def test_a_large_offset_leaves_the_answer_alone():
    src, dst, *_ = problem(22, 120, 0.8)
    offset = np.array([1e4, -1e4, 1e4])
    plain = register(src, dst, noise_bound=0.017)
    far = register(src + offset, dst + offset, noise_bound=0.017)
    np.testing.assert_allclose(plain.dst_from_src.rotmat(), far.dst_from_src.rotmat(), atol=2e-5)
    assert int(far.inliers) == int(plain.inliers)


@pytest.mark.parametrize(
    ("name", "kwargs"),
    [
        ("src", {"src": np.ones((5, 2))}),
        ("dst", {"dst": np.ones((4, 3))}),
        ("weights", {"weights": np.ones(4)}),
        ("covariances", {"covariances": np.ones((5, 3))}),
        ("noise_bound", {"noise_bound": 0.0}),
        ("noise_bound", {"noise_bound": np.nan}),
    ],
)
def test_wrong_arguments_are_named(name, kwargs):
    arguments = {"src": np.ones((5, 3)), "dst": np.ones((5, 3)), "noise_bound": 0.1, **kwargs}
    with pytest.raises(ValueError, match=name):
        register(arguments.pop("src"), arguments.pop("dst"), **arguments)


def test_anisotropic_noise_is_weighed_by_its_covariance():
    """Depth noise ten times the lateral: knowing it halves the error at least."""
    plain, informed = [], []
    for seed in range(8):
        rng = np.random.default_rng(100 + seed)
        src = surface(rng, 100)
        rotmat, xyz = motion(rng)
        deviations = np.array([0.003, 0.003, 0.03])
        dst = src @ rotmat.T + xyz + deviations * rng.normal(size=src.shape)
        plain.append(angle(register(src, dst, noise_bound=0.06).dst_from_src, rotmat))
        answer = register(src, dst, noise_bound=0.06, covariances=np.diag(deviations**2))
        assert int(answer.result) == Result.SUCCESS
        informed.append(angle(answer.dst_from_src, rotmat))
    assert np.median(informed) < 0.5 * np.median(plain)


@pytest.mark.slow
def test_scale_is_found_when_asked_for():
    src, dst, rotmat, *_ = problem(23, 120, 0.8)
    config = RegisterConfig(estimate_scale=True)
    answer = register(src, 2.7 * dst, noise_bound=2.7 * 0.017, config=config)
    np.testing.assert_allclose(answer.scale, 2.7, rtol=0.01)
    assert angle(answer.dst_from_src, rotmat) < 1.5
