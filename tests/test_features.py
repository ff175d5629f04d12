"""The classical front end: what its numbers mean, against closed forms and drawn scenes."""

import cv2
import numpy as np
import pytest

from ltgs_jax.features import (
    Classical,
    FrontEnd,
    dense_descriptors,
    epipolar_distances,
    match_descriptors,
    proposals_from_masks,
    root_sift,
    segment_proposals,
)


def _texture(seed, shape=(240, 320)):
    """Smooth coloured noise over several octaves in [0.1, 0.9]."""
    rng = np.random.default_rng(seed)
    image = np.zeros((*shape, 3), np.float32)
    for sigma in (1.5, 4, 12):
        octave = cv2.GaussianBlur(rng.standard_normal((*shape, 3)).astype(np.float32), (0, 0), sigma)
        image += octave / octave.std()
    return np.clip(0.5 + 0.12 * image, 0.1, 0.9)


def _to_linear(image):
    return np.where(image <= 0.04045, image / 12.92, ((image + 0.055) / 1.055) ** 2.4)


def _to_srgb(linear):
    return np.where(linear <= 0.0031308, linear * 12.92, 1.055 * linear ** (1 / 2.4) - 0.055).astype(np.float32)


def _cosine(a, b):
    return np.sum(a.features * b.features, axis=-1)


def test_classical_is_a_front_end():
    assert isinstance(Classical(), FrontEnd)
    assert Classical(stride=4).fingerprint() != Classical().fingerprint()


@pytest.mark.parametrize("stride", [1, 2, 3])
def test_descriptors_are_unit_and_cover_the_image(stride):
    dense = dense_descriptors(_texture(0)[:101, :67], stride=stride)
    assert dense.features.shape[:2] == (-(-101 // stride), -(-67 // stride))
    assert dense.features.dtype == np.float32
    np.testing.assert_allclose(np.linalg.norm(dense.features, axis=-1), 1, atol=1e-5)


def test_descriptors_ignore_exposure_and_see_other_objects():
    image = _texture(1)
    darker = _to_srgb(0.5 * _to_linear(image))
    other = image.copy()
    other[80:160, 120:220] = _texture(2)[80:160, 120:220] * np.float32([0.5, 0.9, 1.0])
    base = dense_descriptors(image)
    light = _cosine(base, dense_descriptors(darker))
    change = _cosine(base, dense_descriptors(other))
    inside = np.zeros_like(change, bool)
    inside[44:76, 64:106] = True
    far = ~cv2.dilate(inside.astype(np.uint8), np.ones((41, 41))).astype(bool)
    assert np.quantile(light, 0.05) > 0.97
    # The surround of the lightness channel reaches beyond the object, so "unchanged" is near 1, not 1.
    assert np.quantile(change[far], 0.01) > 0.97
    assert np.median(change[inside]) < 0.8
    assert np.quantile(change[inside], 0.9) < np.quantile(light, 0.05)


def test_noise_in_a_flat_region_is_not_texture():
    rng = np.random.default_rng(3)
    flat = np.full((120, 160, 3), 0.5, np.float32)
    noisy = [np.clip(flat + 0.01 * rng.standard_normal(flat.shape).astype(np.float32), 0, 1) for _ in range(2)]
    cosine = _cosine(dense_descriptors(noisy[0]), dense_descriptors(noisy[1]))
    assert np.quantile(cosine, 0.01) > 0.98


def test_descriptors_refuse_what_is_not_an_image():
    with pytest.raises(ValueError, match="expected \\[h w 3\\]"):
        dense_descriptors(np.zeros((10, 10), np.float32))
    with pytest.raises(ValueError, match="finite"):
        dense_descriptors(np.full((10, 10, 3), np.nan, np.float32))
    one_pixel = dense_descriptors(np.zeros((1, 1, 3), np.float32))
    assert np.isfinite(one_pixel.features).all()


def test_proposals_find_drawn_objects():
    image = np.full((240, 320, 3), 0.6, np.float32) + 0.02 * _texture(4)
    truth = []
    shapes = [((60, 60), 30, (0.9, 0.5, 0.1)), ((200, 80), 12, (0.2, 0.3, 0.8)), ((240, 180), 45, (0.1, 0.6, 0.2))]
    for centre, radius, colour in shapes:
        mask = np.zeros((240, 320), np.uint8)
        cv2.circle(mask, centre, radius, 1, -1)
        image[mask > 0] = colour
        truth.append(mask > 0)
    two_tone = np.zeros((240, 320), bool)
    two_tone[150:220, 40:110] = True
    image[150:185, 40:110], image[185:220, 40:110] = (0.5, 0.05, 0.1), (0.95, 0.95, 0.95)
    truth.append(two_tone)
    image += 0.01 * np.random.default_rng(0).standard_normal(image.shape).astype(np.float32)
    proposals = segment_proposals(np.clip(image, 0, 1))
    for mask in truth:
        assert proposals.iou(mask).max() > 0.85
    assert len(proposals) < 400
    again = segment_proposals(np.clip(image, 0, 1))
    np.testing.assert_array_equal(again.members, proposals.members)
    np.testing.assert_array_equal(again.leaves, proposals.leaves)


def test_guide_adds_what_colour_cannot_show():
    image = np.full((120, 160, 3), 0.5, np.float32)
    guide = np.zeros((120, 160), np.float32)
    guide[40:80, 50:100] = 0.8
    best = segment_proposals(image, guide=guide).iou(guide > 0.4).max()
    assert best > 0.85
    assert segment_proposals(image).iou(guide > 0.4).max(initial=0) < 0.5
    with pytest.raises(ValueError, match="guide"):
        segment_proposals(image, guide=guide[1:])


def test_compact_proposals_agree_with_their_masks():
    rng = np.random.default_rng(5)
    masks = rng.random((11, 20, 30)) > 0.6
    proposals = proposals_from_masks(masks)
    np.testing.assert_array_equal(proposals.masks(), masks)
    np.testing.assert_array_equal(proposals.mask(3), masks[3])
    query = rng.random((20, 30)) > 0.5
    expected = [(m & query).sum() / (m | query).sum() for m in masks]
    np.testing.assert_allclose(proposals.iou(query), expected, rtol=1e-6)
    values = rng.random((20, 30)).astype(np.float32)
    np.testing.assert_allclose(proposals.sums(values), [values[m].sum() for m in masks], rtol=1e-5)
    np.testing.assert_array_equal(proposals.subset(np.array([2, 5])).masks(), masks[[2, 5]])
    assert len(proposals_from_masks(np.zeros((0, 4, 4), bool))) == 0


def test_keypoints_follow_the_pixel_convention():
    """A disc is found at its centre, measured from the image's corner; without +0.5 it would be half a pixel off."""
    yy, xx = np.mgrid[:96, :96] + 0.5
    disc = 0.2 + 0.6 * np.exp(-((xx - 48.3) ** 2 + (yy - 44.8) ** 2) / (2 * 6.0**2))
    xy, descriptors = root_sift(np.repeat(disc[..., None].astype(np.float32), 3, axis=-1))
    nearest = xy[np.argmin(np.linalg.norm(xy - [48.3, 44.8], axis=1))]
    np.testing.assert_allclose(nearest, [48.3, 44.8], atol=0.1)
    np.testing.assert_allclose(np.linalg.norm(descriptors, axis=1), 1, atol=1e-3)


def test_matches_under_a_known_warp_masks_and_epipolar_lines():
    image = _texture(6, (300, 400))
    angle, scale = 0.3, 0.9
    warp = np.array(
        [[scale * np.cos(angle), -scale * np.sin(angle), 60], [scale * np.sin(angle), scale * np.cos(angle), -20]]
    )
    # OpenCV's warp works on pixel indices; ours is on positions, half a pixel on.
    to_index = warp.copy()
    to_index[:, 2] += warp[:, :2] @ [0.5, 0.5] - 0.5
    moved = cv2.warpAffine(image, to_index, (400, 300), borderValue=(0.5, 0.5, 0.5))
    matches = Classical().match(image, moved)
    expected = matches.xy_a @ warp[:, :2].T + warp[:, 2]
    error = np.linalg.norm(matches.xy_b - expected, axis=1)
    assert len(matches) > 100
    assert np.mean(error < 1.5) > 0.95
    assert np.median(error) < 0.3
    assert np.all(np.diff(matches.score) <= 1e-6)

    mask = np.zeros(image.shape[:2], bool)
    mask[100:200, 150:250] = True
    masked = Classical().match(image, moved, mask_a=mask)
    assert 0 < len(masked) < len(matches)
    assert mask[np.floor(masked.xy_a[:, 1]).astype(int), np.floor(masked.xy_a[:, 0]).astype(int)].all()

    # Lines through the true positions in an arbitrary direction: F = [epipole]x A for the affine map A.
    epipole = np.array([1.0, 0.3, 0.0])
    cross = np.array([[0, -epipole[2], epipole[1]], [epipole[2], 0, -epipole[0]], [-epipole[1], epipole[0], 0]])
    fundamental = cross @ np.vstack([warp, [0, 0, 1]])
    guided = Classical().match(image, moved, fundamental=fundamental)
    distances = np.diag(epipolar_distances(guided.xy_a, guided.xy_b, fundamental))
    assert distances.max() <= 3.0
    good = np.linalg.norm(guided.xy_b - (guided.xy_a @ warp[:, :2].T + warp[:, 2]), axis=1) < 1.5
    assert good.sum() >= (error < 1.5).sum()


def test_matching_nothing_gives_nothing():
    empty = (np.zeros((0, 2), np.float32), np.zeros((0, 128), np.float32))
    full = root_sift(_texture(7))
    assert len(match_descriptors(empty, full)) == len(match_descriptors(full, empty)) == 0
    grey = np.full((64, 64, 3), 0.5, np.float32)
    assert len(Classical().match(grey, grey)) == 0
