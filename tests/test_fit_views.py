"""Photographs that are decoded when they are needed: the same fit, within a budget of bytes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ltgs_jax.fit import Budget, InitialConfig, StreamedView, View, fit_initial, splats_from_points
from ltgs_jax.fit.views import half_size, halved
from ltgs_jax.geometry import SE3, Camera


def _view(i: int, width: int = 40, height: int = 30) -> View:
    K = jnp.asarray([[40.0, 0, width / 2], [0, 40.0, height / 2], [0, 0, 1]])
    pose = SE3(jnp.asarray([1.0, 0, 0, 0]), jnp.asarray([0.1 * i, 0, 3.0]))
    image = np.random.default_rng(i).integers(0, 256, (height, width, 3), dtype=np.uint8)
    return View(Camera(pose, K, width, height), image, np.ones((height, width), bool))


class _Disk:
    """Photographs and how often each was decoded."""

    def __init__(self, views: list[View], budget: int) -> None:
        self.decoded = [0] * len(views)
        shared = Budget(budget)

        def load(i: int) -> View:
            self.decoded[i] += 1
            return views[i]

        self.views = [StreamedView(v.camera, lambda i=i: load(i), shared) for i, v in enumerate(views)]


@pytest.mark.parametrize("kept", [0, 2, 5])
def test_what_fits_the_budget_is_decoded_once(kept):
    views = [_view(i) for i in range(5)]
    size = 40 * 30 * 4
    disk = _Disk(views, kept * size + size - 1)
    for _ in range(3):
        for streamed, view in zip(disk.views, views, strict=True):
            np.testing.assert_array_equal(streamed.image, view.image)
            np.testing.assert_array_equal(streamed.mask, view.mask)
    assert disk.decoded == [1] * kept + [3] * (5 - kept), "image and mask of one use are one decoding"


def test_half_views_are_streamed_too():
    views = [_view(i, 41, 30) for i in range(3)]
    disk = _Disk(views, 0)
    halves = halved(disk.views)
    assert disk.decoded == [0, 0, 0]
    for half, view in zip(halves, views, strict=True):
        expected = half_size(view)
        np.testing.assert_array_equal(half.image, expected.image)
        np.testing.assert_allclose(half.camera.K, expected.camera.K)
        assert (half.camera.width, half.camera.height) == (20, 15)


@pytest.mark.slow
def test_a_streamed_fit_is_the_same_fit():
    views = [_view(i) for i in range(3)]
    points = np.random.default_rng(0).uniform([-1, -1, -0.5], [1, 1, 0.5], (60, 3))
    start = splats_from_points(points, np.full((60, 3), 0.5), capacity=80, sh_degree=0)
    config = InitialConfig(steps=4, grow_every=2, max_splats=80, sh_degree=0)
    runs = [
        fit_initial(start, which, key=jax.random.key(0), config=config)
        for which in (views, _Disk(views, 40 * 30 * 4).views)
    ]
    np.testing.assert_array_equal(runs[0].splats.means, runs[1].splats.means)
    np.testing.assert_array_equal(runs[0].losses, runs[1].losses)
