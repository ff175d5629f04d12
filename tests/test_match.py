"""Silhouettes of several photographs to objects in space."""

import numpy as np
import pytest

from ltgs_jax.match import Cone, carve, find_instances, grid_around


def _camera(angle: float, *, height: float = 1.5, distance: float = 2.5, size: int = 96) -> np.ndarray:
    """Projection of a camera that looks at the origin from around the table."""
    eye = np.array([distance * np.cos(angle), distance * np.sin(angle), height])
    forward = -eye / np.linalg.norm(eye)
    right = np.cross(forward, [0, 0, 1])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    K = np.array([[size, 0, size / 2], [0, size, size / 2], [0, 0, 1]], float)
    return K @ np.concatenate([rotation, -rotation @ eye[:, None]], axis=1)


def _cone(projection: np.ndarray, boxes, *, size: int = 96) -> Cone:
    """Silhouettes of axis-aligned boxes (centre, half sizes) over the plane z = 0, by casting every pixel's ray."""
    left, translation = projection[:, :3], projection[:, 3]
    eye = -np.linalg.solve(left, translation)
    columns, rows = np.meshgrid(np.arange(size) + 0.5, np.arange(size) + 0.5)
    pixels = np.stack([columns, rows, np.ones_like(rows)], axis=-1).reshape(-1, 3)
    rays = np.linalg.solve(left, pixels.T).T  # scaled so that the ray's parameter is camera z
    depth = np.where(rays[:, 2] < -1e-6, -eye[2] / rays[:, 2], 50.0)
    silhouette = np.zeros(len(rays), bool)
    for center, half in boxes:
        with np.errstate(divide="ignore"):
            a, b = (center - half - eye) / rays, (center + half - eye) / rays
        near, far = np.minimum(a, b).max(axis=1), np.maximum(a, b).min(axis=1)
        silhouette |= (near < far) & (near > 0)
    shape = (size, size)
    return Cone(projection, silhouette.reshape(shape), np.ones(shape, bool), depth.reshape(shape))


_BOXES = [
    (np.array([0.4, 0.0, 0.15]), np.array([0.1, 0.1, 0.15])),
    (np.array([-0.4, 0.2, 0.1]), np.array([0.15, 0.1, 0.1])),
]


def _table() -> np.ndarray:
    grid = np.stack(np.meshgrid(np.linspace(-1, 1, 60), np.linspace(-1, 1, 60)), axis=-1).reshape(-1, 2)
    return np.concatenate([grid, np.zeros((len(grid), 1))], axis=1)


@pytest.mark.parametrize("count", [1, 2])
def test_views_120_degrees_apart_find_each_box_once(count):
    cones = [_cone(_camera(a), _BOXES[:count]) for a in (0.2, 2.3, 4.4)]
    found = find_instances(cones, _table())
    assert len(found) == count
    for instance in found:
        middle = np.median(instance.points, axis=0)
        assert min(np.linalg.norm(middle[:2] - center[:2]) for center, _ in _BOXES[:count]) < 0.1
        assert instance.views == 3


def test_two_boxes_that_a_streak_of_shadow_links_are_two():
    streak = (np.array([0.0, 0.1, 0.01]), np.array([0.5, 0.015, 0.01]))
    cones = [_cone(_camera(a), [*_BOXES, streak]) for a in (0.2, 2.3, 4.4)]
    found = find_instances(cones, _table())
    middles = [np.median(instance.points, axis=0)[:2] for instance in found]
    for center, _ in _BOXES:
        nearest = int(np.argmin([np.linalg.norm(m - center[:2]) for m in middles]))
        assert np.linalg.norm(middles[nearest] - center[:2]) < 0.1
        assert np.ptp(found[nearest].points[:, 0]) < 0.5  # not the other box too


def test_two_boxes_corner_to_corner_are_two():
    corner = [(np.array([x, x, 0.13]), np.array([0.11, 0.11, 0.13])) for x in (-0.125, 0.125)]
    cones = [_cone(_camera(a), corner) for a in (0.2, 2.3, 4.4)]
    middles = sorted(float(np.median(instance.points, axis=0)[0]) for instance in find_instances(cones, _table()))
    np.testing.assert_allclose(middles, [-0.125, 0.125], atol=0.05)


def test_a_mug_keeps_its_handle():
    mug = (np.array([0.0, 0.0, 0.15]), np.array([0.12, 0.12, 0.15]))
    handle = (np.array([0.17, 0.0, 0.15]), np.array([0.06, 0.02, 0.06]))
    cones = [_cone(_camera(a), [mug, handle]) for a in (0.2, 2.3, 4.4)]
    assert len(find_instances(cones, _table())) == 1


def test_nothing_comes_where_another_photograph_sees_nothing():
    cones = [_cone(_camera(0.2), _BOXES[:1]), _cone(_camera(2.3), []), _cone(_camera(4.4), [])]
    assert find_instances(cones, _table()) == []


def test_one_photograph_alone_places_an_object_at_its_contact():
    cone = _cone(_camera(0.2), _BOXES[:1])
    (instance,) = find_instances([cone], _table())
    assert instance.views == 1
    middle = np.median(instance.points, axis=0)
    assert np.linalg.norm(middle[:2] - _BOXES[0][0][:2]) < 0.3


def test_no_silhouette_no_instance():
    assert find_instances([], _table()) == []
    assert find_instances([_cone(_camera(0.2), [])], _table()) == []


def test_carve_keeps_the_box_and_drops_what_is_beside():
    cones = [_cone(_camera(a), _BOXES[:1]) for a in (0.2, 2.3, 4.4)]
    center, half = _BOXES[0]
    inside = center + half * 0.8 * np.random.default_rng(0).uniform(-1, 1, (200, 3))
    outside = center + np.array([0.35, 0, 0])
    counts = carve(np.concatenate([inside, outside[None]]), cones, tolerance=0.0)
    assert (counts[:-1] == [3, 0]).all()
    assert counts[-1, 1] > 0


def test_grid_covers_its_points():
    points = np.random.default_rng(1).normal(size=(50, 3))
    grid = grid_around(points, np.eye(3), resolution=20)
    low, high = grid.centers().min(axis=0), grid.centers().max(axis=0)
    assert (points.min(axis=0) >= low - grid.voxel).all()
    assert (points.max(axis=0) <= high + grid.voxel).all()
