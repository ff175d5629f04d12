"""What difference is expected of a scene that few photographs show, and of one that many show."""

import jax.numpy as jnp
import numpy as np
import pytest

from ltgs_jax.features import Classical
from ltgs_jax.fit import View
from ltgs_jax.geometry import C0, SE3, Camera
from ltgs_jax.pipeline.expected import expected_errors
from ltgs_jax.pipeline.looks import Eye
from ltgs_jax.scene import Splats

_SIDE = 48


class Notes:
    """A progress that remembers what it was told."""

    def __init__(self) -> None:
        self.notes, self.steps = [], 0

    def note(self, text: str) -> None:
        self.notes.append(text)

    def step(self, i: int, n: int, text: str = "") -> None:
        self.steps = n


def _floor(seed: int) -> Splats:
    """A printed floor, its print by seed."""
    grid = np.stack(np.meshgrid(np.arange(-1, 1, 0.08), np.arange(-1, 1, 0.08)), axis=-1).reshape(-1, 2)
    n = len(grid)
    colors = np.random.default_rng(seed).uniform(0.1, 0.9, (n, 3))
    return Splats(
        means=np.c_[grid, np.zeros(n)].astype(np.float32),
        quats=np.tile(np.float32([1, 0, 0, 0]), (n, 1)),
        log_scales=np.full((n, 3), np.log(0.04), np.float32),
        logit_opacities=np.full(n, 3, np.float32),
        sh=((colors[:, None] - 0.5) / C0).astype(np.float32),
    )


def _views(eye: Eye, splats: Splats, count: int) -> list[View]:
    """Photographs of the floor from above, side by side: of few, each shows a strip of its own."""
    K = jnp.asarray([[24.0, 0, _SIDE / 2], [0, 24, _SIDE / 2], [0, 0, 1]])
    views = []
    for x in np.linspace(-0.8, 0.8, count):
        camera = Camera(SE3(jnp.asarray([0.0, 1, 0, 0]), jnp.asarray([-x, 0.0, 0.6])), K, _SIDE, _SIDE)
        image = np.rint(255 * eye.image(splats, camera)).astype(np.uint8)
        views.append(View(camera, image, np.ones((_SIDE, _SIDE), bool)))
    return views


@pytest.mark.parametrize("right", [True, False])
def test_what_few_photographs_show_is_judged_by_those_that_the_fit_did_not_see(right):
    eye, splats, progress, asked = Eye(), _floor(0), Notes(), []
    views = _views(eye, splats, 4)

    def fit_to(rest):
        asked.append([view.camera.center()[0] for view in rest])
        return _floor(0 if right else 1)

    own = expected_errors(eye, splats, views, Classical(), gamma=0.7)
    errors = expected_errors(eye, splats, views, Classical(), gamma=0.7, fit_to=fit_to, progress=progress)
    assert len(asked) == 4 and all(len(rest) == 3 for rest in asked)
    assert progress.steps == 4 and "few photographs" in progress.notes[0]
    assert (errors >= own).all()
    if right:
        np.testing.assert_allclose(errors, own, atol=1e-5)
    else:
        shown = own < 0.1  # by enough pixels for the prior to be small
        assert shown.sum() > 100 and np.median((errors - own)[shown]) > 0.2


def test_many_photographs_of_each_place_need_no_second_fit():
    eye, splats, progress = Eye(), _floor(0), Notes()
    views = _views(eye, splats, 40)

    def fit_to(rest):
        raise AssertionError("not needed")

    errors = expected_errors(eye, splats, views, Classical(), gamma=0.7, fit_to=fit_to, progress=progress)
    assert not progress.notes and np.isfinite(errors).all()


def test_that_nothing_could_be_fitted_without_a_photograph_is_said():
    eye, splats, progress = Eye(), _floor(0), Notes()
    views = _views(eye, splats, 4)
    errors = expected_errors(eye, splats, views, Classical(), gamma=0.7, progress=progress)
    assert "doubtful" in progress.notes[0]
    np.testing.assert_array_equal(errors, expected_errors(eye, splats, views, Classical(), gamma=0.7))
