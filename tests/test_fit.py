"""Growth at fixed capacity, the initial fit, the long fit, the local fit."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ltgs_jax.fit import (
    InitialConfig,
    LongConfig,
    View,
    VisitView,
    Windows,
    fit_chronology,
    fit_initial,
    fit_local,
    photometric_loss,
    splats_from_points,
)
from ltgs_jax.fit.chronology import placements_of
from ltgs_jax.fit.growth import faint, recycle
from ltgs_jax.fit.optimizer import Rates
from ltgs_jax.fit.windows import cover_region, crop_camera
from ltgs_jax.geometry import C0, SE3, Camera, stack_cameras
from ltgs_jax.render import render
from ltgs_jax.scene import Chronology, Shadows, Splats, Template, compose, concatenate_splats, ground_gain

_SIZE = 32


def _camera(x: float) -> Camera:
    K = jnp.asarray([[40.0, 0, 16], [0, 40, 16], [0, 0, 1]])
    return Camera(SE3(jnp.asarray([1.0, 0, 0, 0]), jnp.asarray([x, 0.0, 3.0])), K, _SIZE, _SIZE)


def _cloud(seed: int, count: int = 40, *, spread: float = 0.6) -> Splats:
    rng = np.random.default_rng(seed)
    return Splats(
        means=jnp.asarray(rng.uniform(-spread, spread, (count, 3)), jnp.float32),
        quats=jnp.asarray(rng.normal(size=(count, 4)), jnp.float32),
        log_scales=jnp.asarray(rng.uniform(-2.5, -1.8, (count, 3)), jnp.float32),
        logit_opacities=jnp.asarray(rng.uniform(0, 3, count), jnp.float32),
        sh=jnp.asarray(rng.uniform(-1, 1.5, (count, 1, 3)), jnp.float32),
    )


def _view(splats: Splats, camera: Camera) -> View:
    image = np.clip(np.asarray(render(splats, camera).image), 0, 1)
    return View(camera, np.rint(255 * image).astype(np.uint8), np.ones((_SIZE, _SIZE), bool))


def test_loss_sees_nothing_outside_the_mask():
    rng = np.random.default_rng(0)
    image, target = (jnp.asarray(rng.uniform(size=(24, 24, 3)), jnp.float32) for _ in range(2))
    mask = np.zeros((24, 24), bool)
    mask[4:12, 4:12] = True
    other = jnp.where(jnp.asarray(mask)[..., None], image, 1 - image)
    a = photometric_loss(image, target, jnp.asarray(mask), dssim=0.2)
    b = photometric_loss(other, target, jnp.asarray(mask), dssim=0.2)
    assert float(a) > 0.05
    np.testing.assert_allclose(a, b, rtol=1e-5)


def test_splitting_keeps_the_image_and_fills_free_slots():
    splats = _cloud(1)
    splats = eqx.tree_at(lambda s: s.logit_opacities, splats, splats.logit_opacities.at[30:].set(-20.0))
    scores = jnp.arange(40.0)
    split, replaced = recycle(splats, scores, jnp.asarray(5))
    assert int(jnp.sum(~faint(split))) == 35
    assert int(jnp.sum(replaced)) == 10
    before, after = render(splats, _camera(0.0)).image, render(split, _camera(0.0)).image
    assert float(jnp.mean(jnp.abs(before - after))) < 0.02
    untouched = ~np.asarray(replaced)
    np.testing.assert_array_equal(np.asarray(split.means)[untouched], np.asarray(splats.means)[untouched])


def test_nothing_is_split_without_error_or_room():
    splats = _cloud(2)
    for scores in (jnp.zeros(40), jnp.ones(40)):  # no error; no free slot
        split, replaced = recycle(splats, scores, jnp.asarray(8))
        assert not bool(replaced.any())
        assert all(bool((a == b).all()) for a, b in zip(jax.tree.leaves(split), jax.tree.leaves(splats), strict=True))


def test_points_become_splats_with_their_colours_and_too_few_are_refused():
    rng = np.random.default_rng(3)
    points, colors = rng.uniform(-1, 1, (10, 3)), rng.uniform(size=(10, 3))
    splats = splats_from_points(points, colors, capacity=16, sh_degree=1)
    assert splats.sh.shape == (16, 4, 3)
    np.testing.assert_allclose(np.asarray(splats.sh[:10, 0]) * 0.28209479 + 0.5, colors, atol=1e-6)
    np.testing.assert_array_equal(np.asarray(faint(splats)), np.arange(16) >= 10)
    with pytest.raises(ValueError, match="at least 4"):
        splats_from_points(points[:3], colors[:3], capacity=16, sh_degree=0)


def test_initial_fit_learns_and_repeats_bit_for_bit():
    truth = _cloud(4)
    views = [_view(truth, _camera(x)) for x in (-0.3, 0.0, 0.3)]
    rng = np.random.default_rng(5)
    start = splats_from_points(
        np.asarray(truth.means) + rng.normal(scale=0.02, size=(40, 3)),
        np.full((40, 3), 0.5),
        capacity=64,
        sh_degree=0,
    )
    config = InitialConfig(steps=60, max_splats=64, sh_degree=0, coarse_fraction=0.0, grow_every=20)
    first = fit_initial(start, views, key=jax.random.key(0), config=config)
    assert first.losses[-6:].mean() < 0.6 * first.losses[:6].mean()
    again = fit_initial(start, views, key=jax.random.key(0), config=config)
    np.testing.assert_array_equal(first.losses, again.losses)
    with pytest.raises(ValueError, match="at least one photograph"):
        fit_initial(start, [], key=jax.random.key(0))


def _moved_chronology(error: float) -> tuple[Chronology, Chronology]:
    """A chronology whose one object moved at visit 1, and the same with its pose off by `error`."""
    background, item = _cloud(6), _cloud(7, 20, spread=0.2)
    poses = SE3(
        jnp.asarray([[[1.0, 0, 0, 0]], [[0.98, 0, 0, 0.2]]]), jnp.asarray([[[0.0, 0, -0.5]], [[0.3, 0.1, -0.5]]])
    )
    truth = Chronology(
        background, (Template(item, 1, 0),), poses, jnp.ones((2, 1), bool), jnp.zeros((0, 3, 2)), ("a", "b")
    )
    off = eqx.tree_at(lambda c: c.world_from_template.xyz, truth, poses.xyz.at[1, 0, 0].add(error))
    return truth, off


def test_long_fit_finds_the_pose_and_leaves_the_rest_alone():
    truth, off = _moved_chronology(0.06)
    views = [VisitView(_view(compose(truth, t), _camera(x)), t) for t in (0, 1) for x in (-0.3, 0.0, 0.3)]
    config = LongConfig(passes=16, background_rate=0.0, translation_rate=0.02, rotation_rate=2e-3)
    fitted, losses = fit_chronology(off, views, key=jax.random.key(0), config=config)
    goal = truth.world_from_template.xyz[1, 0]
    before = float(jnp.linalg.norm(off.world_from_template.xyz[1, 0] - goal))
    after = float(jnp.linalg.norm(fitted.world_from_template.xyz[1, 0] - goal))
    assert after < 0.5 * before
    assert losses[-10:].mean() < losses[:10].mean()
    for a, b in zip(jax.tree.leaves(fitted.background), jax.tree.leaves(off.background), strict=True):
        np.testing.assert_array_equal(a, b)
    # The pose at the visit that the template was cut from is its frame, and stays.
    np.testing.assert_allclose(fitted.world_from_template.xyz[0], off.world_from_template.xyz[0], atol=1e-7)


def test_long_fit_stops_where_what_is_held_out_gets_worse_and_goes_back():
    truth, _ = _moved_chronology(0.0)
    rng, views, said = np.random.default_rng(3), [], []
    for t in (0, 1):
        for x in (-0.3, 0.0, 0.3):
            view = _view(compose(truth, t), _camera(x))
            grainy = np.clip(view.image + rng.normal(scale=60, size=view.image.shape), 0, 255).astype(np.uint8)
            views.append(VisitView(View(view.camera, grainy, view.mask), t))
    config = LongConfig(passes=60, rates=Rates(means=5e-3, means_final=5e-3, sh_dc=3e-2))
    _, losses = fit_chronology(
        truth, views, key=jax.random.key(0), config=config, progress=lambda i, n, text: said.append((n, text))
    )
    assert "what is held out came out best after" in said[-1][1] and len(losses) < said[0][0] / 2


@pytest.mark.parametrize("shining", [False, True])
def test_what_has_no_colour_that_depends_on_the_direction_gets_none(shining):
    _, off = _moved_chronology(0.03)
    truth = compose(off, 1)
    views = [VisitView(_view(truth, _camera(x)), 1) for x in (-0.3, 0.3)]
    rest = jnp.full((off.templates[0].splats.count, 3, 3), 0.1 * shining)
    sh = jnp.concatenate([0.5 * off.templates[0].splats.sh, rest], axis=1)
    start = eqx.tree_at(lambda c: c.templates[0].splats.sh, off, sh)
    fitted, _ = fit_chronology(start, views, key=jax.random.key(0), config=LongConfig(passes=2))
    after = fitted.templates[0].splats.sh
    assert (np.asarray(after[:, 1:]) != np.asarray(rest)).any() == shining
    assert (np.asarray(after[:, 0]) != np.asarray(sh[:, 0])).any()


def test_long_fit_changes_nothing_far_from_what_changed():
    _, off = _moved_chronology(0.03)
    # Splats in a corner that the object never comes near, in cameras large enough for windows to leave it out.
    far = eqx.tree_at(lambda s: s.means, _cloud(9, 30), _cloud(9, 30).means * 0.3 + jnp.asarray([-1.6, -1.6, 0.0]))
    background = concatenate_splats([off.background, far])
    since = jnp.asarray([0] * background.count, jnp.int32).at[:5].set(1)
    off = eqx.tree_at(lambda c: (c.background, c.since), off, (background, since), is_leaf=lambda x: x is None)
    K = jnp.asarray([[80.0, 0, 96], [0, 80, 96], [0, 0, 1]])
    cameras = [eqx.tree_at(lambda c: c.K, _camera(x), K) for x in (-0.2, 0.2)]
    cameras = [Camera(c.cam_from_world, c.K, 192, 192) for c in cameras]
    blank = np.full((192, 192, 3), 128, np.uint8)
    views = [VisitView(View(c, blank, np.ones((192, 192), bool)), t) for t in (0, 1) for c in cameras]
    fitted, losses = fit_chronology(off, views, key=jax.random.key(0), config=LongConfig(passes=3))
    assert len(losses) > 0
    recoloured = np.any(np.asarray(fitted.background.sh) != np.asarray(background.sh), axis=(1, 2))
    assert recoloured[:40].any() and not recoloured[40:].any()
    moved = np.any(np.asarray(fitted.background.means) != np.asarray(background.means), axis=1)
    assert moved[:40].any() and not moved[np.asarray(since) == 0].any()  # late ground alone
    again, _ = fit_chronology(off, views, key=jax.random.key(0), config=LongConfig(passes=3))
    for a, b in zip(jax.tree.leaves(fitted), jax.tree.leaves(again), strict=True):
        np.testing.assert_array_equal(a, b)


def _lit(splats: Splats, shade) -> np.ndarray:
    """Log of the gain that a shade puts on splats, from its definition."""
    return np.asarray(shade[0] + np.asarray(splats.means) @ np.asarray(shade[1:]))


def test_a_shade_is_a_gain_on_every_colour():
    truth, _ = _moved_chronology(0.0)
    shade = jnp.zeros((2, 1, 4)).at[1, 0].set(jnp.asarray([0.1, 0.5, -0.3, 0.2]))
    lit = eqx.tree_at(lambda c: c.shade, truth, shade, is_leaf=lambda leaf: leaf is None)
    item = truth.templates[0].splats
    colours = [C0 * np.asarray(compose(c, 1).sh)[-item.count :, 0] + 0.5 for c in (truth, lit)]
    np.testing.assert_allclose(colours[1], np.exp(_lit(item, shade[1, 0]))[:, None] * colours[0], rtol=1e-5)
    for a, b in zip(jax.tree.leaves(compose(truth, 0)), jax.tree.leaves(compose(lit, 0)), strict=True):
        np.testing.assert_array_equal(a, b)


def test_long_fit_finds_how_an_object_is_lit_where_it_stands_now():
    unlit, _ = _moved_chronology(0.0)
    shade = jnp.zeros((2, 1, 4)).at[1, 0].set(jnp.asarray([-0.3, 0.5, 0.0, 0.0]))
    truth = eqx.tree_at(lambda c: c.shade, unlit, shade, is_leaf=lambda leaf: leaf is None)
    views = [VisitView(_view(compose(truth, t), _camera(x)), t) for t in (0, 1) for x in (-0.3, 0.0, 0.3)]
    still = Rates(means=1e-12, means_final=1e-12, quats=0, log_scales=0, logit_opacities=0, sh_dc=0, sh_rest=0)
    config = LongConfig(passes=40, background_rate=0.0, translation_rate=0.0, rotation_rate=0.0, rates=still)
    fitted, losses = fit_chronology(unlit, views, key=jax.random.key(0), config=config)
    item = truth.templates[0].splats
    np.testing.assert_array_equal(fitted.shade[0], np.zeros((1, 4)))  # where it was first seen
    wanted, found = (_lit(item, s) for s in (shade[1, 0], fitted.shade[1, 0]))
    assert np.abs(found - wanted).mean() < 0.25 * np.abs(wanted).mean()
    assert losses[-10:].mean() < 0.5 * losses[:10].mean()
    without, _ = fit_chronology(
        unlit, views, key=jax.random.key(0), config=dataclasses.replace(config, passes=2, shade_rate=0.0)
    )
    assert not np.asarray(without.shade).any()


def test_a_shadow_darkens_the_ground_where_and_while_it_is_cast():
    cast = jnp.asarray([[False, True], [True, True], [True, False]])
    shadows = Shadows(jnp.asarray([[0.0, 0, 0], [1, 0, 0]]), jnp.full(2, 0.1), jnp.asarray([-0.5, 0.2]), cast)
    means = jnp.asarray([[0.0, 0, 0], [0.1, 0, 0], [1, 0, 0], [5, 5, 5]])
    since = jnp.zeros(4, jnp.int32)
    half = np.exp(-0.5)
    gains = [np.asarray(ground_gain(shadows, means, since, t)) for t in range(3)]
    np.testing.assert_array_equal(gains[0], 0)
    np.testing.assert_allclose(gains[1], [-0.5, -0.5 * half, 0, 0], rtol=1e-6)
    np.testing.assert_allclose(gains[2], [-0.5, -0.5 * half, -0.2, 0], rtol=1e-6)
    # Ground that came to light at visit 1 has that visit's shadows in its colours.
    np.testing.assert_allclose(ground_gain(shadows, means, since + 1, 2), [0, 0, -0.2, 0], rtol=1e-6)
    np.testing.assert_allclose(ground_gain(shadows, means, since + 1, 0), [0.5, 0.5 * half, 0, 0], rtol=1e-6)
    slope = jax.grad(lambda g: ground_gain(eqx.tree_at(lambda s: s.log_gain, shadows, g), means, since, 1).sum())
    np.testing.assert_allclose(slope(shadows.log_gain), [1 + half, 0], rtol=1e-6)


def test_long_fit_finds_the_shadow_of_what_moved():
    plain, _ = _moved_chronology(0.0)
    middle = np.asarray(plain.world_from_template.xyz[1, 0])
    blob = Shadows(jnp.asarray(middle)[None], jnp.full(1, 0.2), jnp.full(1, -0.8), jnp.asarray([[False], [True]]))
    truth = eqx.tree_at(lambda c: c.shadows, plain, blob, is_leaf=lambda leaf: leaf is None)
    views = [VisitView(_view(compose(truth, t), _camera(x)), t) for t in (0, 1) for x in (-0.3, 0.0, 0.3)]
    still = Rates(means=1e-12, means_final=1e-12, quats=0, log_scales=0, logit_opacities=0, sh_dc=0, sh_rest=0)
    config = LongConfig(passes=40, background_rate=0.0, translation_rate=0.0, rotation_rate=0.0, rates=still)
    fitted, losses = fit_chronology(plain, views, key=jax.random.key(0), config=config)
    assert losses[-10:].mean() < 0.7 * losses[:10].mean()
    for a, b in zip(jax.tree.leaves(fitted.background), jax.tree.leaves(plain.background), strict=True):
        np.testing.assert_array_equal(a, b)
    count = plain.background.count
    wanted, found, before = (np.asarray(compose(c, 1).sh[:count, 0]) for c in (truth, fitted, plain))
    assert np.abs(found - wanted).sum() < 0.6 * np.abs(before - wanted).sum()
    np.testing.assert_array_equal(compose(fitted, 0).sh[:count], compose(plain, 0).sh[:count])


def test_windows_hold_every_pixel_of_a_region():
    rng = np.random.default_rng(0)
    for _ in range(20):
        region = np.zeros((120, 160), bool)
        for _ in range(rng.integers(1, 5)):
            y, x = rng.integers(0, 110), rng.integers(0, 150)
            region[y : y + rng.integers(1, 60), x : x + rng.integers(1, 80)] = True
        covered = np.zeros_like(region)
        corners = cover_region(region, 40, 3)
        for left, top in corners:
            assert 0 <= left <= 120 and 0 <= top <= 80
            covered[top : top + 40, left : left + 40] = True
        assert covered[region].all()
        assert len(corners) <= 4 + 3 * region.sum() / 40**2
    assert cover_region(np.zeros((50, 50), bool), 40, 3) == []


def test_a_window_s_camera_sees_its_part_of_the_image():
    splats, camera = _cloud(10), _camera(0.1)
    whole = render(splats, camera).image
    part = render(splats, crop_camera(camera, 7, 11, 16)).image
    np.testing.assert_allclose(part, whole[11:27, 7:23], atol=2e-5)


def test_an_object_that_stays_has_one_pose():
    truth, _ = _moved_chronology(0.0)
    still = SE3(
        jnp.repeat(truth.world_from_template.quat[:1], 2, 0), jnp.repeat(truth.world_from_template.xyz[:1], 2, 0)
    )
    placements = placements_of(eqx.tree_at(lambda c: c.world_from_template, truth, still))
    assert placements.poses.xyz.shape == (1, 3)
    assert placements_of(truth).poses.xyz.shape == (2, 3)


def test_long_fit_wants_a_later_photograph():
    truth, _ = _moved_chronology(0.0)
    views = [VisitView(_view(compose(truth, 0), _camera(0.0)), 0)]
    with pytest.raises(ValueError, match="later visit, 1 or beyond"):
        fit_chronology(truth, views, key=jax.random.key(0))
    views.append(VisitView(_view(compose(truth, 1), _camera(0.0)), 1))
    with pytest.raises(ValueError, match="later visit, 2 or beyond"):
        fit_chronology(truth, views, key=jax.random.key(0), since=2)


def test_local_fit_lowers_the_error_in_its_windows():
    truth = _cloud(8, 20, spread=0.2)
    cameras = stack_cameras([_camera(x) for x in (-0.3, 0.3)])
    target = render(truth, cameras).image
    windows = Windows(
        cameras,
        target,
        jnp.zeros_like(target),
        jnp.zeros(target.shape[:-1]),
        jnp.ones(target.shape[:-1], bool),
    )
    start = eqx.tree_at(lambda s: (s.sh, s.logit_opacities), truth, (0 * truth.sh, truth.logit_opacities - 2))
    fitted, losses, _ = fit_local(start, windows, size=0.5, steps=40)
    assert losses[-1] < 0.5 * losses[0]
    assert fitted.count == start.count
