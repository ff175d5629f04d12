"""Scores of masks, identities, events and poses on cases whose answer is known."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ltgs_jax.geometry import SE3
from ltgs_jax.metrics import assign_objects, event_f1, mask_f1, mask_iou, metric, rotation_deg, translation_rel


def _se3(rotation: Rotation, xyz) -> SE3:
    return SE3(jnp.asarray(rotation.as_quat()[[3, 0, 1, 2]]), jnp.asarray(xyz, float))


def test_masks_of_known_overlap():
    found, true = np.zeros((2, 10, 10), bool)
    found[:4, :5] = True  # 20 pixels
    true[2:6, :5] = True  # 20 pixels, 10 shared
    assert mask_iou(found, true) == pytest.approx(10 / 30)
    assert mask_f1(found, true) == pytest.approx(0.5)
    assert mask_iou(found, found) == mask_f1(found, found) == 1
    assert mask_iou(found, ~found) == mask_f1(found, ~found) == 0


def test_empty_masks():
    empty, full = np.zeros((4, 4), bool), np.ones((4, 4), bool)
    assert mask_iou(empty, empty) == mask_f1(empty, empty) == 1
    assert mask_iou(empty, full) == mask_f1(empty, full) == 0
    with pytest.raises(ValueError, match="found"):
        mask_iou(empty, full[:2])


def test_assignment_is_the_best_over_all_not_greedy():
    """Greedy pairs 1 with 7 (12/23) and leaves 2 with nothing; 1 with 8 (8/20) and 2 with 7 (3/15) is more in all."""
    found, true = np.zeros((2, 1, 30), int)
    found[0, :20], found[0, 20:23] = 1, 2
    true[0, :8], true[0, 8:23] = 8, 7
    assert assign_objects([found], [true]) == {1: 8, 2: 7}


def test_assignment_pools_photographs_and_drops_strangers():
    rng = np.random.default_rng(0)
    true = [rng.integers(0, 4, (20, 30)) for _ in range(3)]
    names = np.array([0, 12, 11, 300])
    found = [names[labels] for labels in true]
    assert assign_objects(found, true) == {12: 1, 11: 2, 300: 3}
    stranger = [np.where(labels == 300, 0, labels) for labels in found]
    assert assign_objects(stranger, true) == {12: 1, 11: 2}
    assert assign_objects([], []) == {}
    assert assign_objects([np.zeros((4, 4), int)], [np.ones((4, 4), int)]) == {}
    with pytest.raises(ValueError, match="found"):
        assign_objects(found, true[:2])


def test_events():
    true = {(1, 1): "moved", (2, 1): "still", (3, 1): "removed", (4, 2): "added"}
    found = {(10, 1): "moved", (20, 1): "still", (30, 1): "moved", (99, 2): "added"}
    assignment = {10: 1, 20: 2, 30: 3}
    assert event_f1(found, true, assignment) == pytest.approx(2 * 1 / (3 + 3))
    assert event_f1({}, {}, {}) == 1
    assert event_f1({(1, 1): "still"}, {(1, 1): "still"}, {1: 1}) == 1
    assert event_f1({(1, 1): "moved"}, {}, {}) == 0
    assert event_f1({(5, 1): "moved"}, {(5, 1): "moved"}, {}) == 0, "an id without a partner is not the true one"


@pytest.mark.parametrize("degrees", [0.0, 1e-4, 3.0, 90.0, 179.999, 180.0])
def test_rotation_error_is_the_angle_between(degrees):
    with jax.enable_x64(True):
        start = Rotation.from_rotvec([0.3, -1.2, 0.7])
        turn = Rotation.from_rotvec(np.radians(degrees) * np.array([2, -1, 2]) / 3)
        found, true = _se3(start, [1, 2, 3]), _se3(turn * start, [4, 5, 6])
        assert rotation_deg(found, true) == pytest.approx(degrees, abs=1e-6)


def test_rotation_about_an_axis_of_symmetry_does_not_count():
    with jax.enable_x64(True):
        start = Rotation.from_rotvec([0.3, -1.2, 0.7])
        axis = np.array([0.0, 0.0, 2.0])
        spun = start * Rotation.from_euler("z", 130, degrees=True)
        assert rotation_deg(_se3(start, [0, 0, 0]), _se3(spun, [0, 0, 0]), axis=axis) == pytest.approx(0, abs=1e-6)
        tilted = start * Rotation.from_euler("zx", [130, 7], degrees=True)
        assert rotation_deg(_se3(start, [0, 0, 0]), _se3(tilted, [0, 0, 0]), axis=axis) == pytest.approx(7)


def test_translation_error_is_taken_at_the_middle_of_the_object():
    """A turn about the middle moves nothing there, however far the world's origin is."""
    with jax.enable_x64(True):
        center = np.array([5.0, 1.0, 0.5])
        turn = Rotation.from_euler("z", 40, degrees=True)
        about_middle = _se3(turn, center - turn.apply(center))
        still = _se3(Rotation.identity(), [0, 0, 0])
        shifted = _se3(Rotation.identity(), [0.03, 0, 0.04])
        assert translation_rel(about_middle, still, center=center, size=0.2) == pytest.approx(0, abs=1e-12)
        assert translation_rel(about_middle, shifted, center=center, size=0.2) == pytest.approx(0.25)


def test_a_row_of_metrics():
    row = metric("rotation_deg", np.float32(2.5), visit="after").to_json()
    expected = {"key": "rotation_deg", "visit": "after", "region": "full", "value": 2.5, "unit": "deg"}
    assert row == {**expected, "direction": "lower"}
    assert metric("psnr", 20, visit=None, region="changed").direction == "higher"
