"""Change masks: light taken out, differences found, nothing found where nothing is."""

import numpy as np
import pytest
from scipy import ndimage

from ltgs_jax.detect import change_map, clean, dilate, fit_tone, similarity
from ltgs_jax.features import Classical


def _room(seed: int, shape=(96, 128)) -> np.ndarray:
    """A textured picture: blurred noise in colour, with edges."""
    rng = np.random.default_rng(seed)
    noise = ndimage.gaussian_filter(rng.uniform(size=(*shape, 3)), (3, 3, 0))
    noise = (noise - noise.min()) / np.ptp(noise)
    return (0.2 + 0.6 * noise).astype(np.float32)


@pytest.mark.parametrize("gain", [0.5, 1.6])
def test_tone_recovers_exposure_past_a_changed_quarter(gain):
    room = _room(0)
    lit = np.clip(room * np.float32(gain) ** [0.9, 1.0, 1.1], 0, 1).astype(np.float32)
    lit[:48, :64] = _room(1)[:48, :64]
    tone = fit_tone(lit, room, np.ones(room.shape[:2], bool))
    assert tone.changed
    usable = (lit.max(axis=-1) < 0.98)[48:]
    assert np.abs(tone(lit) - room)[48:][usable].mean() < 0.02


def test_the_same_light_is_left_alone():
    room = _room(0)
    noisy = room + np.random.default_rng(2).normal(scale=0.01, size=room.shape).astype(np.float32)
    tone = fit_tone(noisy, room, np.ones(room.shape[:2], bool))
    assert not tone.changed
    np.testing.assert_array_equal(tone(noisy), noisy)


def test_similarity_of_equal_images_is_one():
    room = _room(3)
    np.testing.assert_allclose(similarity(room, room, Classical(), gamma=0.7), 1, atol=1e-5)


def test_identical_images_give_an_empty_mask():
    room = _room(4)
    valid = np.ones(room.shape[:2], bool)
    found = change_map(room, room, np.zeros(room.shape[:2], np.float32), valid, Classical())
    assert not found.mask.any()
    assert not found.two_classes


@pytest.mark.parametrize(
    "other", [lambda room: _room(11), lambda room: room[::-1], lambda room: np.roll(room, 16, axis=1)]
)
def test_a_picture_changed_everywhere_says_so_and_finds_nothing(other):
    room = _room(4)
    valid = np.ones(room.shape[:2], bool)
    found = change_map(room, other(room), np.full(room.shape[:2], 0.02, np.float32), valid, Classical())
    assert found.everywhere
    assert not found.mask.any()
    assert not found.score.any()
    assert not found.left.any()


def test_noise_blur_light_and_a_large_object_are_not_a_change_everywhere():
    room = _room(4)
    valid = np.ones(room.shape[:2], bool)
    noisy = room + np.random.default_rng(12).normal(scale=0.02, size=room.shape).astype(np.float32)
    blurred = ndimage.gaussian_filter(room, (1, 1, 0))
    large = room.copy()
    large[:, :50] = _room(13)[:, :50]
    for picture in (noisy, blurred, np.clip(0.6 * room, 0, 1), large):
        lit = fit_tone(picture, room, valid)(picture)
        found = change_map(room, lit, np.full(room.shape[:2], 0.02, np.float32), valid, Classical())
        assert not found.everywhere
        assert found.mask.mean() < 0.5
    assert found.mask[:, 5:45].mean() > 0.8


def test_a_new_object_is_found_and_noise_is_not():
    room = _room(5)
    rng = np.random.default_rng(6)
    captured = room + rng.normal(scale=0.01, size=room.shape).astype(np.float32)
    captured[30:60, 40:80] = [0.9, 0.1, 0.1]
    true = np.zeros(room.shape[:2], bool)
    true[30:60, 40:80] = True
    found = change_map(room, captured, np.zeros(true.shape, np.float32), np.ones_like(true), Classical())
    assert (found.mask & true).sum() > 0.95 * true.sum()
    assert (found.mask & ~dilate(true, 6)).sum() == 0


def test_what_left_is_told_from_what_came():
    room = _room(9)
    flat = np.full_like(room, 0.5)
    rng = np.random.default_rng(10)
    thing = rng.uniform(size=(30, 40, 3)).astype(np.float32)
    rendered, captured = flat.copy(), flat.copy()
    rendered[10:40, 10:50] = thing
    captured[50:80, 70:110] = thing
    noise = rng.normal(scale=0.005, size=room.shape).astype(np.float32)
    expected = np.zeros(room.shape[:2], np.float32)
    found = change_map(rendered, captured + noise, expected, np.ones(room.shape[:2], bool), Classical())
    assert found.mask[15:35, 15:45].mean() > 0.95 and found.mask[55:75, 75:105].mean() > 0.95
    assert found.left[15:35, 15:45].mean() > 0.9
    assert found.left[55:75, 75:105].mean() < 0.1
    assert found.left[60:, :40].mean() < -0.5


def test_an_expected_error_is_no_change():
    room = _room(7)
    captured = room.copy()
    captured[30:60, 40:80] = 0.5
    expected = np.zeros(room.shape[:2], np.float32)
    expected[24:66, 34:86] = 1.0
    found = change_map(room, captured, expected, np.ones(room.shape[:2], bool), Classical())
    assert not found.mask[34:56, 44:76].any()


def test_ignored_pixels_never_change():
    room = _room(8)
    captured = room.copy()
    captured[30:60, 40:80] = 0.9
    valid = np.ones(room.shape[:2], bool)
    valid[26:64, 36:84] = False
    assert not change_map(room, captured, np.zeros(valid.shape, np.float32), valid, Classical()).mask.any()


def test_clean_fills_holes_and_drops_specks():
    mask = np.zeros((100, 100), bool)
    mask[20:40, 20:40] = True
    mask[28:31, 28:31] = False
    mask[80, 80] = True
    cleaned = clean(mask, 4e-3)
    assert cleaned[29, 29]
    assert not cleaned[80, 80]
