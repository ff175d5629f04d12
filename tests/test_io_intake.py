"""A phone's folder made into the images/ of a capture: orders, names, orientations, refusals."""

import cv2
import numpy as np
import OpenImageIO as oiio
import pytest

from ltgs_jax.io import InputError, bring_in, bring_mask, find_intake, read_pixels, sharpest, write_image
from ltgs_jax.io.images import read_header


def _photograph(path, *, width=40, height=24, orientation=1, equivalent=None, blur=0.0, seed=0):
    """A photograph of noise with a white corner, stored turned so that EXIF sets it upright; returns it upright."""
    upright = (255 * np.random.default_rng(seed).random((height, width, 3))).astype(np.uint8)
    upright = cv2.GaussianBlur(cv2.resize(upright, None, fx=1, fy=1), (0, 0), 1.0 + blur)
    upright[: height // 3, : width // 4] = 255
    turned = {1: upright, 3: np.rot90(upright, 2), 6: np.rot90(upright, 1), 8: np.rot90(upright, 3)}[orientation]
    path.parent.mkdir(parents=True, exist_ok=True)
    spec = oiio.ImageSpec(turned.shape[1], turned.shape[0], 3, "uint8")
    spec["Orientation"] = orientation
    if equivalent is not None:
        spec.attribute("Exif:FocalLengthIn35mmFilm", oiio.TypeDesc("uint"), equivalent)
    output = oiio.ImageOutput.create(str(path))
    assert output.open(str(path), spec) and output.write_image(np.ascontiguousarray(turned)) and output.close()
    return upright


@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
def test_photographs_are_set_upright_with_their_focal_length(tmp_path, orientation):
    upright = _photograph(tmp_path / "in" / "visit" / "a.jpg", orientation=orientation, equivalent=27)
    (photograph,) = find_intake(tmp_path / "in")[0]["visit"]
    brought = bring_in(photograph, tmp_path / "images", max_side=None)
    assert (brought.width, brought.height) == (40, 24)
    assert brought.focal == pytest.approx(27 / 36 * 40)
    written = tmp_path / "images" / brought.name
    assert read_header(written).orientation == 1
    assert np.abs(read_pixels(written).astype(int) - upright).mean() < 12  # JPEG twice; any other turn is off by 30


def test_large_photographs_are_reduced_and_upright_ones_copied(tmp_path):
    _photograph(tmp_path / "in" / "v" / "a.jpg", width=200, height=100, equivalent=36)
    _photograph(tmp_path / "in" / "v" / "b.jpg")
    a, b = find_intake(tmp_path / "in")[0]["v"]
    reduced = bring_in(a, tmp_path / "images", max_side=50)
    assert (reduced.width, reduced.height, reduced.focal) == (50, 25, pytest.approx(50))
    bring_in(b, tmp_path / "images", max_side=50)
    assert (tmp_path / "images" / b.name).read_bytes() == b.source.read_bytes()


def test_visits_come_in_natural_order_or_as_told(tmp_path):
    for name in ("day 10", "day 2", "after"):
        _photograph(tmp_path / name / "IMG 1.JPG")
    found, remarks = find_intake(tmp_path)
    assert list(found) == ["after", "day_2", "day_10"] and not remarks
    assert [p.name for p in found["day_2"]] == ["day_2/IMG_1.jpg"]
    told, _ = find_intake(tmp_path, order=["day 10", "day 2", "after"])
    assert list(told) == ["0_day_10", "1_day_2", "2_after"]
    with pytest.raises(InputError, match="--visits"):
        find_intake(tmp_path, order=["day 2", "after"])


def test_names_that_a_capture_cannot_hold_are_changed(tmp_path):
    for name in ("a.jpg", "a.png", "a b.jpg", "a#b.jpg"):
        _photograph(tmp_path / "v" / name)
    names = [p.name for p in find_intake(tmp_path)[0]["v"]]
    stems = [name.rsplit(".", 1)[0].lower() for name in names]
    assert len(set(stems)) == 4 and all(set(name) <= set("abv_2/.jpng") for name in names), names


@pytest.mark.parametrize("name, way", [("a.HEIC", "heif-convert"), ("a.mov", "ffmpeg"), ("a.dng", "JPEG")])
def test_what_is_not_read_is_refused_with_the_way_to_convert_it(tmp_path, name, way):
    (tmp_path / "v").mkdir()
    (tmp_path / "v" / name).write_bytes(b"x")
    with pytest.raises(InputError, match=way) as refused:
        find_intake(tmp_path)
    assert name in str(refused.value) and "\n" not in str(refused.value)


def test_a_live_photograph_s_clip_beside_its_picture_is_passed_over(tmp_path):
    _photograph(tmp_path / "v" / "a.jpg")
    (tmp_path / "v" / "a.mov").write_bytes(b"x")
    assert [p.name for p in find_intake(tmp_path)[0]["v"]] == ["v/a.jpg"]


def test_empty_and_missing_folders_are_named(tmp_path):
    with pytest.raises(InputError, match="no such folder"):
        find_intake(tmp_path / "none")
    with pytest.raises(InputError, match="one folder of photographs per visit"):
        find_intake(tmp_path)


def test_of_a_video_s_frames_the_sharpest_of_each_stretch_are_kept(tmp_path):
    for i in range(12):
        sharp = i in (1, 5, 8, 10)
        _photograph(tmp_path / "v" / f"{i:03d}.png", blur=0.0 if sharp else 3.0, seed=i)
    frames = find_intake(tmp_path)[0]["v"]
    assert [p.name for p in sharpest(frames, 4)] == [f"v/{i:03d}.png" for i in (1, 5, 8, 10)]
    assert sharpest(frames, 12) == frames


@pytest.mark.parametrize("place", ["visit/a.jpg.png", "visit/a.png", "visit.png"])
def test_masks_come_along_upright_and_reduced(tmp_path, place):
    _photograph(tmp_path / "in" / "visit" / "a.jpg", width=80, height=40, orientation=6)
    mask = np.ones((40, 80, 3), np.float32)
    mask[30:, 10:50] = 0
    write_image(tmp_path / "in" / "masks" / place, mask)
    found, remarks = find_intake(tmp_path / "in")
    assert list(found) == ["visit"] and not remarks, "masks are no visit"
    upright = bring_in(found["visit"][0], tmp_path / "images", max_side=40)
    bring_mask(found["visit"][0], upright, tmp_path / "masks")
    brought = read_pixels(tmp_path / "masks" / "visit" / "a.jpg.png")[..., 0]
    assert brought.shape == (20, 40)
    np.testing.assert_array_equal(brought == 0, (mask[1::2, ::2, 0] == 0))


def test_a_mask_of_another_shape_is_named(tmp_path):
    _photograph(tmp_path / "in" / "visit" / "a.jpg")
    write_image(tmp_path / "in" / "masks" / "visit.png", np.ones((40, 24, 3), np.float32))
    (photograph,) = find_intake(tmp_path / "in")[0]["visit"]
    upright = bring_in(photograph, tmp_path / "images", max_side=None)
    with pytest.raises(InputError, match=r"visit\.png: is 24×40, its photograph 40×24"):
        bring_mask(photograph, upright, tmp_path / "masks")
