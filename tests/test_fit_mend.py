"""The background where the first visit hardly showed it: what is mended, what is not lost, when nothing is kept."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ltgs_jax.fit import MendConfig, View, VisitView, mend_background
from ltgs_jax.geometry import SE3, Camera
from ltgs_jax.pipeline.looks import Eye
from ltgs_jax.pipeline.unknown import barely_shown, without_unexplained
from ltgs_jax.scene import Chronology, Splats, Template, compose

_SIZE = 32
_CONFIG = MendConfig(passes=40)
_EYE = Eye()  # one program for all images


def _camera(x: float) -> Camera:
    K = jnp.asarray([[40.0, 0, 16], [0, 40, 16], [0, 0, 1]])
    return Camera(SE3(jnp.asarray([1.0, 0, 0, 0]), jnp.asarray([x, 0.0, 3.0])), K, _SIZE, _SIZE)


def _wall(seed: int) -> Splats:
    """Two patches of a wall, side by side, too far apart for one camera: around x = 0 and around x = 4."""
    rng = np.random.default_rng(seed)
    x, y = (
        a.ravel() for a in np.meshgrid(np.r_[np.linspace(-1, 1, 12), np.linspace(3, 5, 12)], np.linspace(-1, 1, 12))
    )
    count = len(x)
    return Splats(
        means=jnp.asarray(np.stack([x, y, np.zeros(count)], axis=-1), jnp.float32),
        quats=jnp.tile(jnp.asarray([[1.0, 0, 0, 0]]), (count, 1)),
        log_scales=jnp.full((count, 3), -2.2, jnp.float32),
        logit_opacities=jnp.full(count, 2.0, jnp.float32),
        sh=jnp.asarray(rng.uniform(-1, 1, (count, 1, 3)), jnp.float32),
    )


def _chronology(background: Splats) -> Chronology:
    item = eqx.tree_at(lambda s: s.means, background[:6], background.means[:6] * 0.2 + jnp.asarray([0.0, 0, -0.3]))
    return Chronology(
        background,
        (Template(item, 1, 0),),
        SE3.identity((2, 1)),
        jnp.asarray([[True], [False]]),
        jnp.zeros((0, 3, 2)),
        ("a", "b"),
    )


def _photographs(truth: Chronology) -> list[VisitView]:
    """The first visit sees the one patch, the later one both."""
    at = [(0, x) for x in (-0.2, 0.0, 0.2)] + [(1, x) for x in (0.0, -3.9, -4.1)]
    views = []
    for t, x in at:
        image = _EYE.image(compose(truth, t), _camera(x))
        pixels = np.rint(255 * image).astype(np.uint8)
        views.append(VisitView(View(_camera(x), pixels, np.ones((_SIZE, _SIZE), bool)), t))
    return views


def _unknown_beyond() -> tuple[Chronology, list[VisitView]]:
    """A chronology that knows the first patch but for some noise and has the other one grey; photographs of the
    truth."""
    truth = _chronology(_wall(0))
    noisy = truth.background.sh + 0.3 * jax.random.normal(jax.random.key(1), truth.background.sh.shape)
    sh = jnp.where(truth.background.means[:, :1, None] > 2, 0, noisy)
    return eqx.tree_at(lambda c: c.background.sh, truth, sh), _photographs(truth)


def _error(chronology: Chronology, views, t: int) -> float:
    images = [(_EYE.image(compose(chronology, t), v.view.camera), v.view) for v in views if v.visit == t]
    return float(np.mean([np.abs(image - v.image / 255.0).mean() for image, v in images]))


def test_what_the_first_visit_did_not_show_is_mended_and_what_it_showed_is_kept():
    chronology, views = _unknown_beyond()
    mended = mend_background(chronology, views, key=jax.random.key(0), config=_CONFIG)
    assert mended.kept
    assert _error(mended.chronology, views, 1) < 0.5 * _error(chronology, views, 1)
    assert _error(mended.chronology, views, 0) < _error(chronology, views, 0)
    assert mended.unseen[1] < 0.6 * mended.unseen[0]
    for a, b in zip(jax.tree.leaves(mended.chronology.templates), jax.tree.leaves(chronology.templates), strict=True):
        np.testing.assert_array_equal(a, b)
    again = mend_background(chronology, views, key=jax.random.key(0), config=_CONFIG)
    np.testing.assert_array_equal(mended.losses, again.losses)


def test_what_would_be_forgotten_of_the_first_visit_is_not_kept():
    chronology, views = _unknown_beyond()
    dark = [v if v.visit == 0 else VisitView(dataclasses.replace(v.view, image=v.view.image // 4), 1) for v in views]
    config = dataclasses.replace(_CONFIG, replay=0.0)
    mended = mend_background(chronology, dark, key=jax.random.key(0), config=config)
    assert mended.unseen[1] < mended.unseen[0]  # the later photographs alone would have it so
    assert mended.first[1] > 1.01 * mended.first[0]
    assert not mended.kept
    for a, b in zip(jax.tree.leaves(mended.chronology), jax.tree.leaves(chronology), strict=True):
        np.testing.assert_array_equal(a, b)


def test_a_fit_that_is_not_finite_is_not_kept(monkeypatch):
    chronology, views = _unknown_beyond()
    monkeypatch.setattr("ltgs_jax.fit.mend._step", lambda inputs, background, state, *_: (background, state, np.nan, 0))
    mended = mend_background(chronology, views, key=jax.random.key(0), config=_CONFIG)
    assert not mended.kept
    assert len(mended.losses) == 0
    for a, b in zip(jax.tree.leaves(mended.chronology), jax.tree.leaves(chronology), strict=True):
        np.testing.assert_array_equal(a, b)


def test_mending_asks_for_photographs_of_both():
    chronology, views = _unknown_beyond()
    for some in (views[:3], views[3:]):
        with pytest.raises(ValueError, match="first and of later visits"):
            mend_background(chronology, some, key=jax.random.key(0), config=_CONFIG)


def test_the_unknown_is_what_later_photographs_show_more_of_than_all_of_the_first():
    chronology, views = _unknown_beyond()
    barely, share = barely_shown(chronology, views[:3], views[3:], _EYE)
    beyond = np.asarray(chronology.background.means)[:, 0] > 2
    assert (barely & ~beyond).sum() < 8  # of 144: those at the edge
    assert (barely & beyond).sum() > 0.5 * beyond.sum()
    assert 0.5 < share < 0.8  # two of three photographs
    assert barely_shown(chronology, views[:3], views[3:4], _EYE)[1] < 0.05


def test_a_change_that_nobody_explained_is_left_out_but_not_where_nobody_knew_better():
    chronology, views = _unknown_beyond()
    later = views[3:]
    barely, _ = barely_shown(chronology, views[:3], later, _EYE)
    image = later[0].view.image.copy()
    image[10:16, 10:16] = np.where(image[10:16, 10:16] < 128, 255, 0)
    later[0] = VisitView(dataclasses.replace(later[0].view, image=image), 1)
    kept = without_unexplained(chronology, barely, later, _EYE, sigmas=5.0)
    assert kept[0].view.mask[11:15, 11:15].mean() < 0.3
    assert kept[0].view.mask[:8].all()
    assert all(v.view.mask.all() for v in kept[1:])
