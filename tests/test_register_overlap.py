"""Correspondences by features, and the geometric verification of a registration."""

import jax.numpy as jnp
import numpy as np
import pytest
from register_problems import surface

from ltgs_jax.geometry import SE3
from ltgs_jax.register import chamfer, match_features, verify_overlap


def test_chamfer_is_the_distance_to_the_nearest_point():
    rng = np.random.default_rng(8)
    a, b = rng.normal(size=(300, 3)), rng.normal(size=(57, 3))
    expected = np.linalg.norm(a[:, None] - b[None], axis=-1).min(1)
    np.testing.assert_allclose(chamfer(jnp.asarray(a, jnp.float32), jnp.asarray(b, jnp.float32)), expected, atol=1e-5)


def test_overlap_accepts_a_partial_view_and_refuses_a_shifted_one():
    rng = np.random.default_rng(9)
    points = surface(rng, 400)
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
