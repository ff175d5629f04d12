"""Robust registration against known motions and closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ltgs_jax.geometry import SE3
from ltgs_jax.register import Result, chamfer, match_features, register, verify_overlap


def _motion(rng) -> tuple[np.ndarray, np.ndarray]:
    return Rotation.random(random_state=int(rng.integers(1 << 31))).as_matrix(), rng.normal(size=3)


def _shape(rng, count: int) -> np.ndarray:
    """Points of a lopsided closed surface of size about 1."""
    directions = rng.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    radius = 0.35 + 0.1 * directions[:, 0] * directions[:, 1] + 0.1 * directions[:, 2] ** 3
    return directions * radius[:, None] * np.array([1.0, 0.8, 0.6])


def _problem(seed: int, count: int, outliers: float, sigma: float = 0.005):
    rng = np.random.default_rng(seed)
    src = _shape(rng, count)
    rotmat, xyz = _motion(rng)
    wrong = rng.permutation(count) < round(outliers * count)
    partner = np.where(wrong, rng.permutation(count), np.arange(count))
    dst = src[partner] @ rotmat.T + xyz + sigma * rng.normal(size=src.shape)
    return src, dst, rotmat, xyz, ~wrong


def _angle(answer: SE3, rotmat: np.ndarray) -> float:
    return np.degrees(Rotation.from_matrix(np.asarray(answer.rotmat(), np.float64).T @ rotmat).magnitude())


@pytest.mark.parametrize("outliers", [0.0, 0.5, 0.8])
def test_recovers_the_motion_among_outliers(outliers):
    src, dst, rotmat, xyz, inlier = _problem(1, 100, outliers)
    answer = register(src, dst, noise_bound=0.017)
    assert int(answer.result) == Result.SUCCESS
    assert _angle(answer.dst_from_src, rotmat) < 1.0
    moved = np.asarray(answer.dst_from_src.apply(jnp.asarray(src, jnp.float32)))
    assert np.abs(moved - (src @ rotmat.T + xyz)).max() < 0.02
    weights = np.asarray(answer.inlier_weights)
    assert weights.shape == (100,)
    assert weights[inlier].mean() > 0.9
    assert float(answer.confidence) > 0.95


def test_least_squares_limit_is_kabsch():
    """With a bound far above the noise the robust optimum is the closed-form least squares."""
    src, dst, *_ = _problem(2, 100, 0.0)
    answer = register(src, dst, noise_bound=1.0)
    rotation, _ = Rotation.align_vectors(dst - dst.mean(0), src - src.mean(0))
    assert _angle(answer.dst_from_src, rotation.as_matrix()) < 2e-3
    expected = dst.mean(0) - rotation.as_matrix() @ src.mean(0)
    np.testing.assert_allclose(answer.dst_from_src.xyz, expected, atol=2e-5)


def test_weights_of_zero_mark_absent_rows():
    src, dst, rotmat, *_ = _problem(3, 80, 0.5)
    src[:10] = np.nan
    dst[10:20] = 1e6
    weights = np.ones(80)
    weights[10:20] = 0
    answer = register(src, dst, noise_bound=0.017, weights=weights)
    assert int(answer.result) == Result.SUCCESS
    assert _angle(answer.dst_from_src, rotmat) < 1.5
    assert np.all(np.asarray(answer.inlier_weights)[:20] == 0)


@pytest.mark.parametrize("count", [0, 1, 2])
def test_fewer_than_three_points_are_a_failure_with_its_reason(count):
    answer = register(np.ones((count, 3)), np.ones((count, 3)), noise_bound=0.1)
    assert int(answer.result) == Result.TOO_FEW_POINTS
    assert float(answer.confidence) == 0
    assert "fewer than 3" in Result(int(answer.result)).reason


def test_no_consensus_is_a_failure():
    rng = np.random.default_rng(4)
    answer = register(_shape(rng, 100), _shape(rng, 100), noise_bound=0.017)
    assert int(answer.result) == Result.NO_CONSENSUS


def test_a_line_of_inliers_names_its_axis():
    rng = np.random.default_rng(5)
    axis = np.array([0.6, 0.0, 0.8])
    src = rng.uniform(-0.5, 0.5, 80)[:, None] * axis
    rotmat, xyz = _motion(rng)
    answer = register(src, src @ rotmat.T + xyz + 0.002 * rng.normal(size=src.shape), noise_bound=0.007)
    assert bool(answer.ambiguous)
    assert abs(np.asarray(answer.ambiguous_axis) @ axis) > 0.999
    turned = np.asarray(answer.dst_from_src.rotmat()) @ axis
    assert turned @ (rotmat @ axis) > 0.9999
    assert np.isfinite(np.asarray(answer.covariance)).all()


def test_the_second_of_two_motions_is_reported():
    rng = np.random.default_rng(6)
    src = _shape(rng, 120)
    (first, t1), (second, t2) = _motion(rng), _motion(rng)
    dst = np.where(np.arange(120)[:, None] < 70, src @ first.T + t1, src @ second.T + t2)
    answer = register(src, dst + 0.003 * rng.normal(size=src.shape), noise_bound=0.01)
    assert _angle(answer.dst_from_src, first) < 1
    assert _angle(answer.second, second) < 1
    assert 40 <= int(answer.second_inliers) <= 55


@pytest.mark.parametrize(
    ("name", "kwargs"),
    [("src", {"src": np.ones((5, 2))}), ("dst", {"dst": np.ones((4, 3))}), ("weights", {"weights": np.ones(4)})],
)
def test_wrong_shapes_name_the_argument(name, kwargs):
    arguments = {"src": np.ones((5, 3)), "dst": np.ones((5, 3)), **kwargs}
    with pytest.raises(ValueError, match=name):
        register(arguments.pop("src"), arguments.pop("dst"), noise_bound=0.1, **arguments)


def test_a_bound_that_is_not_positive_is_refused():
    with pytest.raises(ValueError, match="noise_bound"):
        register(np.ones((5, 3)), np.ones((5, 3)), noise_bound=0.0)


def test_traced_inputs_agree_with_concrete_ones():
    src, dst, *_ = _problem(7, 128, 0.6)
    plain = register(src, dst, noise_bound=0.017)
    traced = jax.jit(lambda a, b: register(a, b, noise_bound=0.017))(
        jnp.asarray(src, jnp.float32), jnp.asarray(dst, jnp.float32)
    )
    np.testing.assert_allclose(plain.dst_from_src.as_matrix(), traced.dst_from_src.as_matrix(), atol=1e-4)


def test_chamfer_is_the_distance_to_the_nearest_point():
    rng = np.random.default_rng(8)
    a, b = rng.normal(size=(300, 3)), rng.normal(size=(57, 3))
    expected = np.linalg.norm(a[:, None] - b[None], axis=-1).min(1)
    np.testing.assert_allclose(chamfer(jnp.asarray(a, jnp.float32), jnp.asarray(b, jnp.float32)), expected, atol=1e-5)


def test_overlap_accepts_a_partial_view_and_refuses_a_shifted_one():
    rng = np.random.default_rng(9)
    points = _shape(rng, 400)
    src, dst = points[points[:, 0] > -0.1], points[points[:, 0] < 0.1]
    right = verify_overlap(SE3.identity(), jnp.asarray(src, jnp.float32), jnp.asarray(dst, jnp.float32))
    wrong = SE3(SE3.identity().quat, jnp.asarray([0.4, 0.0, 0.3], jnp.float32))
    shifted = verify_overlap(wrong, jnp.asarray(src, jnp.float32), jnp.asarray(dst, jnp.float32))
    assert bool(right.accepted)
    assert not bool(shifted.accepted)
    swapped = verify_overlap(SE3.identity(), jnp.asarray(dst, jnp.float32), jnp.asarray(src, jnp.float32))
    np.testing.assert_allclose(right.distance, swapped.distance, rtol=1e-6)


def test_mutual_nearest_features_find_the_permutation():
    rng = np.random.default_rng(10)
    features = rng.normal(size=(50, 16))
    order = rng.permutation(50)
    rows, cols, cosines = match_features(features, features[order] + 0.05 * rng.normal(size=(50, 16)))
    assert len(rows) == 50
    np.testing.assert_array_equal(order[cols], rows)
    assert np.all(np.diff(cosines) <= 0)
    with pytest.raises(ValueError, match="dst_features"):
        match_features(features, features[:, :8])


def test_top_k_keeps_more_candidates():
    rng = np.random.default_rng(11)
    a, b = rng.normal(size=(30, 4)), rng.normal(size=(40, 4))
    one, _, _ = match_features(a, b)
    three, _, _ = match_features(a, b, top_k=3)
    assert len(three) > len(one)
