"""Captures: layouts, roles, photographs, masks, faults."""

import dataclasses
import json
import struct
import zlib

import cv2
import jax.numpy as jnp
import numpy as np
import OpenImageIO as oiio
import pytest
from scipy.spatial.transform import Rotation

from ltgs_jax import io
from ltgs_jax.geometry import SE3
from ltgs_jax.io.colmap import ColmapImage, ColmapModel
from ltgs_jax.io.lens import CameraModel

PINHOLE = CameraModel("PINHOLE", 32, 24, (30.0, 31.0, 16.0, 12.0))


def noise(width: int = 32, height: int = 24, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).random((height, width, 3)).astype(np.float32)


def make_capture(folder, counts=(16, 3, 2), *, lens=PINHOLE, posed=lambda visit, index: True, suffix=".png"):
    """Photographs of noise with a model of those that are `posed`; one point, seen by the first two images."""
    images = {}
    for visit, count in enumerate(counts):
        for index in range(count):
            name = f"IMG_{visit:04d}/{index:03d}{suffix}"
            io.write_image(folder / "images" / name, noise(seed=100 * visit + index))
            if posed(visit, index):
                quat = np.random.default_rng(index).normal(size=4)
                pixels, ids = np.array([[3.0, 4.0]]), np.array([7])
                images[len(images) + 1] = ColmapImage(name, 1, quat, np.array([index, visit, 2.0]), pixels, ids)
    track = np.array([(0, 1, 0), (0, 2, 0)])
    colors = np.array([[255, 0, 51]], np.uint8)
    model = ColmapModel({1: lens}, images, np.array([7]), np.array([[1.0, 2.0, 3.0]]), colors, np.zeros(1), track)
    io.write_colmap(folder / "sparse" / "0", model)
    return folder


def roles(capture) -> dict[str, str]:
    return {photograph.name: photograph.role for photograph in capture.photographs}


def test_plain_capture(tmp_path):
    capture = io.read_capture(make_capture(tmp_path))
    assert capture.visits == ("IMG_0000", "IMG_0001", "IMG_0002")
    assert [p.name for p in capture.at(0, "test")] == ["IMG_0000/000.png", "IMG_0000/008.png"]
    assert len(capture.at(0, "train")) == 14 and len(capture.at(1, "update")) == 3 and len(capture.at(2)) == 2
    assert not capture.problems and capture.initial_ply is None
    np.testing.assert_allclose(capture.point_colors, [[1, 0, 0.2]])
    np.testing.assert_array_equal(capture.point_observations.photographs, [0, 1])
    np.testing.assert_array_equal(capture.point_observations.pixels, [[3, 4], [3, 4]])
    photograph = capture.photographs[5]
    np.testing.assert_allclose(photograph.camera.K, PINHOLE.K(), rtol=1e-6)
    expected = Rotation.from_quat(np.random.default_rng(5).normal(size=4)[[1, 2, 3, 0]]).as_matrix()
    np.testing.assert_allclose(photograph.camera.cam_from_world.rotmat(), expected, atol=1e-6)
    np.testing.assert_allclose(io.load_image(photograph), noise(seed=5), atol=0.5 / 255 + 1e-6)
    assert io.load_mask(photograph).all()


def test_lists_give_the_roles(tmp_path):
    make_capture(tmp_path)
    (tmp_path / "images" / "changes.txt").write_text("IMG_0001/000.png\nIMG_0002/001.png\nIMG_0002/009.png\n")
    (tmp_path / "images" / "test.txt").write_text("IMG_0000/003.png\r\nIMG_0001/002.png\nIMG_0002/001.png\n\n")
    capture = io.read_capture(tmp_path)
    found = roles(capture)
    assert [name for name, role in found.items() if role == "test"] == [
        "IMG_0000/003.png",
        "IMG_0001/002.png",
        "IMG_0002/001.png",
    ]
    assert [name for name, role in found.items() if role == "update"] == ["IMG_0001/000.png"]
    assert found["IMG_0001/001.png"] == "unused" and found["IMG_0000/000.png"] == "train"
    assert [name for name, _ in capture.problems] == ["IMG_0002/009.png", "IMG_0002/001.png"]


def test_sparse_first_visit_holds_nothing_out(tmp_path):
    assert set(roles(io.read_capture(make_capture(tmp_path, (5, 2)))).values()) == {"train", "update"}


def test_unposed_photographs_keep_a_lens(tmp_path):
    capture = io.read_capture(make_capture(tmp_path, posed=lambda visit, index: visit == 0 and index % 2 == 0))
    by_name = {p.name: p for p in capture.photographs}
    assert by_name["IMG_0000/002.png"].lens_given and by_name["IMG_0000/002.png"].camera is not None
    later = by_name["IMG_0001/000.png"]
    assert later.camera is None and not later.lens_given and later.camera_model == PINHOLE


def test_capture_without_a_model(tmp_path):
    io.write_image(tmp_path / "images" / "a" / "0.png", noise())
    capture = io.read_capture(tmp_path)
    assert capture.colmap_model is None and capture.photographs[0].camera_model is None
    assert capture.points.shape == (0, 3) and io.load_image(capture.photographs[0]).shape == (24, 32, 3)


def test_undistortion_agrees_with_opencv_and_labels_go_back(tmp_path):
    lens = CameraModel("OPENCV", 32, 24, (30.0, 31.0, 16.0, 12.0, 0.4, -0.05, 0.01, -0.02))
    capture = io.read_capture(make_capture(tmp_path, lens=lens))
    photograph = capture.photographs[1]
    smooth = cv2.GaussianBlur(noise(), (0, 0), 3)
    io.write_image(photograph.path, smooth)
    stored = cv2.imread(str(photograph.path))[..., ::-1].astype(np.float32) / 255
    # OpenCV puts the first pixel's centre at 0.
    K = lens.K() - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    expected = cv2.undistort(stored, K, lens.distortion())
    inside = io.load_mask(photograph)
    assert 0.7 < inside.mean() < 1
    image = io.load_image(photograph)
    core = cv2.erode(inside.astype(np.uint8), np.ones((3, 3)), borderValue=0) > 0
    np.testing.assert_allclose(image[core], expected[core], atol=2 / 255)
    labels = np.zeros((24, 32), np.int32)
    labels[8:16, 10:24] = 300
    back = io.distort_labels(labels, photograph)
    source = lenses_map(lens)
    again = cv2.remap(back.astype(np.uint16), source, None, cv2.INTER_NEAREST)
    assert (again != labels).mean() < 0.03 and set(np.unique(back)) == {0, 300}


def lenses_map(lens):
    return io.lens.undistort_map(lens, lens.K())


def test_reduced_images_fit_the_resized_camera(tmp_path):
    photograph = io.read_capture(make_capture(tmp_path)).photographs[0]
    image = io.load_image(photograph, max_side=16)
    assert image.shape == (12, 16, 3) and io.load_mask(photograph, max_side=16).shape == (12, 16)
    np.testing.assert_allclose(image[0, 0], io.load_image(photograph)[:2, :2].mean(axis=(0, 1)), atol=1e-6)
    np.testing.assert_array_equal(io.distort_labels(np.eye(12, 16, dtype=int), photograph)[::2, ::2], np.eye(12, 16))


@pytest.mark.parametrize("kind", ["uint8", "uint16"])
@pytest.mark.parametrize("channels", [1, 2, 3, 4])
def test_kinds_of_pixels(tmp_path, kind, channels):
    top = np.iinfo(kind).max
    pixels = (np.random.default_rng(0).random((24, 32, channels)) * top).astype(kind)
    if channels in (2, 4):
        pixels[..., -1] = 0
        pixels[4:9, 5:11, -1] = top
    path = tmp_path / "images" / "v" / "a.png"
    path.parent.mkdir(parents=True)
    output = oiio.ImageOutput.create(str(path))
    spec = oiio.ImageSpec(32, 24, channels, kind)
    spec.attribute("oiio:UnassociatedAlpha", 1)
    assert output.open(str(path), spec) and output.write_image(pixels) and output.close()
    photograph = io.read_capture(tmp_path).photographs[0]
    image = io.load_image(photograph)
    expected = pixels[..., :1].repeat(3, axis=-1) if channels < 3 else pixels[..., :3]
    np.testing.assert_allclose(image, expected / top, atol=1e-6)
    assert image.dtype == np.float32 and io.load_mask(photograph).sum() == (30 if channels in (2, 4) else 24 * 32)


def write_oriented(path, pixels, orientation):
    spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], 3, "uint8")
    spec.attribute("Orientation", orientation)
    spec.attribute("Compression", "jpeg:100")
    output = oiio.ImageOutput.create(str(path))
    assert output.open(str(path), spec) and output.write_image(pixels) and output.close()


@pytest.mark.parametrize("orientation", range(1, 9))
def test_exif_orientation_only_where_the_camera_wants_it(tmp_path, orientation):
    """As stored when the model has the stored size; turned, as OpenCV does, when it has the turned size."""
    smooth = cv2.GaussianBlur(noise(), (0, 0), 2)
    stored = (smooth * 255).astype(np.uint8)
    make_capture(tmp_path, (2,), suffix=".jpg")
    for name in ("000.jpg", "001.jpg"):
        write_oriented(tmp_path / "images" / "IMG_0000" / name, stored, orientation)
    photograph = io.read_capture(tmp_path).photographs[0]
    assert not photograph.oriented
    np.testing.assert_allclose(io.load_image(photograph), stored / 255, atol=0.05)
    if orientation >= 5:
        turned = dataclasses.replace(PINHOLE, width=24, height=32)
        make_model_only(tmp_path, turned)
        photograph = io.read_capture(tmp_path).photographs[0]
        assert photograph.oriented and (photograph.width, photograph.height) == (24, 32)
        image = io.load_image(photograph)
        expected = cv2.imread(str(photograph.path))[..., ::-1] / 255
        np.testing.assert_allclose(image, expected, atol=0.02)
        labels = (image[..., 0] > 0.5).astype(np.uint8)
        back = io.distort_labels(labels, photograph)
        assert ((stored[..., 0] > 127) == back).mean() > 0.9


def make_model_only(folder, lens):
    model = io.read_colmap(folder / "sparse" / "0")
    io.write_colmap(folder / "sparse" / "0", dataclasses.replace(model, cameras={1: lens}))


@pytest.mark.parametrize("name", ["masks/IMG_0000/001.png", "masks/IMG_0000/001.jpg.png"])
def test_masks_by_either_name(tmp_path, name):
    make_capture(tmp_path, suffix=".jpg")
    labels = np.full((24, 32), 255, int)
    labels[:10] = 0
    io.write_labels(tmp_path / name, labels)
    photographs = io.read_capture(tmp_path).photographs
    np.testing.assert_array_equal(io.load_mask(photographs[1]), labels > 0)
    assert io.load_mask(photographs[0]).all()
    io.write_labels(tmp_path / name, labels[:20])
    with pytest.raises(io.InputError, match=r"001.*is 32×20, its photograph 32×24"):
        io.load_mask(photographs[1])


@pytest.mark.parametrize("top", [255, 256, 65535])
def test_labels_of_8_and_16_bits_return(tmp_path, top):
    labels = np.array([[0, 1, top], [2, 3, 4]])
    io.write_labels(tmp_path / "a.png", labels)
    read = io.read_labels(tmp_path / "a.png")
    np.testing.assert_array_equal(read, labels)
    assert read.dtype == (np.uint8 if top < 256 else np.uint16)
    with pytest.raises(ValueError, match="65536"):
        io.write_labels(tmp_path / "a.png", labels + 65536 - top)


def test_scaled_photographs_scale_their_camera(tmp_path):
    make_capture(tmp_path, lens=CameraModel("PINHOLE", 128, 96, (120.0, 124.0, 64.0, 48.0)))
    photograph = io.read_capture(tmp_path).photographs[0]
    np.testing.assert_allclose(photograph.camera.K, PINHOLE.K(), rtol=1e-6)
    assert photograph.camera.width == 32


# --- other layouts ---


def test_periods_in_folders_named_t(tmp_path):
    for visit, period in enumerate(("t0", "t2", "t10")):
        inside = tmp_path / period / "images" if visit == 0 else tmp_path / period
        io.write_image(inside / "a.png", noise(seed=visit))
    capture = io.read_capture(tmp_path)
    assert capture.visits == ("t0", "t2", "t10")
    assert [p.name for p in capture.photographs] == ["t0/a.png", "t2/a.png", "t10/a.png"]


def test_rgb_and_rgb_new_with_transforms(tmp_path):
    frames = []
    for folder in ("rgb", "rgb_new"):
        io.write_image(tmp_path / folder / "a.png", noise())
        frames.append({"file_path": f"{folder}/a.png", "transform_matrix": np.eye(4).tolist()})
    (tmp_path / "transforms.json").write_text(json.dumps({"fl_x": 30, "frames": frames}))
    capture = io.read_capture(tmp_path)
    assert capture.visits == ("rgb", "rgb_new")
    assert all(p.camera is not None for p in capture.photographs)


def test_transforms_turn_the_axes_of_blender(tmp_path):
    rng = np.random.default_rng(0)
    rotation, centre = Rotation.random(random_state=1).as_matrix(), rng.normal(size=3)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, centre
    io.write_image(tmp_path / "images" / "a.png", noise())
    frames = [{"file_path": "./images/a", "transform_matrix": pose.tolist()}]
    # Flat images/ would be one visit anyway; the frame names its own.
    content = {"camera_angle_x": 2 * np.arctan(16 / 30), "frames": [{**frames[0], "time": 3}]}
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    camera = io.read_capture(tmp_path).photographs[0].camera
    np.testing.assert_allclose(camera.center(), centre, atol=1e-6)
    # Blender looks along its −z, its y is up.
    pixels, depth = camera.project(jnp.asarray([centre - 2 * rotation[:, 2] + 0.5 * rotation[:, 1]], jnp.float32))
    np.testing.assert_allclose(depth, 2, atol=1e-5)
    np.testing.assert_allclose(pixels, [[16, 12 - 30 * 0.25]], atol=1e-4)


def test_split_file_of_periods(tmp_path):
    make_capture(tmp_path, (2,))
    for name in ("a.png", "b.png", "c.png"):
        io.write_image(tmp_path / "images" / name, noise())
    (tmp_path / "sparse" / "split.txt").write_text("a.png 0\nc.png 0\nb.png 1\n")
    capture = io.read_capture(tmp_path)
    assert capture.visits == ("t0", "t1")
    assert [p.name for p in capture.photographs] == ["t0/a.png", "t0/c.png", "t1/b.png"]


# --- faults ---


def test_missing_folder_and_file(tmp_path):
    with pytest.raises(io.InputError, match="nowhere: no such folder"):
        io.read_capture(tmp_path / "nowhere")
    with pytest.raises(io.InputError, match="no photographs found"):
        io.read_capture(tmp_path)
    (tmp_path / "images").mkdir()
    with pytest.raises(io.InputError, match="no visit in it"):
        io.read_capture(tmp_path)


def test_empty_visit_is_named(tmp_path):
    make_capture(tmp_path)
    (tmp_path / "images" / "IMG_0003").mkdir()
    with pytest.raises(io.InputError, match="IMG_0003: no photograph"):
        io.read_capture(tmp_path)


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".webp", ".tif"])
@pytest.mark.parametrize("damage", ["empty", "text", "half", "head"])
def test_one_bad_photograph_is_a_problem_and_the_rest_goes_on(tmp_path, suffix, damage):
    make_capture(tmp_path, suffix=suffix)
    path = tmp_path / "images" / "IMG_0001" / f"001{suffix}"
    whole = path.read_bytes()
    path.write_bytes(
        {"empty": b"", "text": b"hello" * 99, "half": whole[: len(whole) // 2], "head": whole[:30]}[damage]
    )
    capture = io.read_capture(tmp_path)
    if capture.problems or damage != "half" or suffix in (".jpg", ".png"):
        assert [name for name, _ in capture.problems] == [f"IMG_0001/001{suffix}"]
        assert len(capture.photographs) == 20
    else:
        # Formats whose end cannot be told from their header show it when they are decoded.
        with pytest.raises(io.InputError, match=rf"001\{suffix}"):
            io.load_image(next(p for p in capture.photographs if p.path == path))


def test_a_visit_of_bad_photographs_is_an_error(tmp_path):
    make_capture(tmp_path)
    for path in (tmp_path / "images" / "IMG_0002").iterdir():
        path.write_bytes(b"\x89PNG\r\n\x1a\n")
    with pytest.raises(io.InputError, match=r"visit IMG_0002.*000\.png"):
        io.read_capture(tmp_path)


def test_two_sizes_with_one_camera(tmp_path):
    make_capture(tmp_path)
    io.write_image(tmp_path / "images" / "IMG_0001" / "002.png", noise(16, 12))
    with pytest.raises(io.InputError, match=r"002\.png.*16×12 and 32×24"):
        io.read_capture(tmp_path)


def test_hostile_image_sizes_are_not_believed(tmp_path):
    make_capture(tmp_path)
    path = tmp_path / "images" / "IMG_0001" / "001.png"
    content = bytearray(path.read_bytes())
    content[16:24] = struct.pack(">II", 15000, 15000)
    content[29:33] = struct.pack(">I", zlib.crc32(bytes(content[12:29])))
    path.write_bytes(content)
    ((name, reason),) = io.read_capture(tmp_path).problems
    assert name == "IMG_0001/001.png" and "15000×15000" in reason


def test_two_names_for_one_result(tmp_path):
    """renders/<visit>/<name>.png could not hold both."""
    make_capture(tmp_path)
    io.write_image(tmp_path / "images" / "IMG_0001" / "001.jpg", noise())
    with pytest.raises(io.InputError, match=r"001\.png: IMG_0001/001\.jpg has the same name"):
        io.read_capture(tmp_path)


def test_exif_focal_length_in_pixels(tmp_path):
    make_capture(tmp_path, suffix=".jpg")
    path = tmp_path / "images" / "IMG_0001" / "001.jpg"
    spec = oiio.ImageSpec(32, 24, 3, "uint8")
    spec.attribute("Exif:FocalLengthIn35mmFilm", 27)
    output = oiio.ImageOutput.create(str(path))
    assert output.open(str(path), spec) and output.write_image(np.zeros((24, 32, 3), np.uint8)) and output.close()
    focal = {p.name: p.exif_focal for p in io.read_capture(tmp_path).photographs}
    assert focal["IMG_0001/001.jpg"] == pytest.approx(24) and focal["IMG_0001/000.jpg"] is None


def test_phone_data_behind_the_end_of_a_jpeg_is_fine(tmp_path):
    make_capture(tmp_path, suffix=".jpg")
    path = tmp_path / "images" / "IMG_0001" / "001.jpg"
    path.write_bytes(path.read_bytes() + b"\0" * 300_000)
    assert not io.read_capture(tmp_path).problems


def test_heic_is_refused_with_the_way_out(tmp_path):
    make_capture(tmp_path)
    (tmp_path / "images" / "IMG_0001" / "x.HEIC").write_bytes(b"....ftypheic")
    ((name, reason),) = io.read_capture(tmp_path).problems
    assert name == "IMG_0001/x.HEIC" and "convert" in reason


@pytest.mark.parametrize("file_path", ["../../x.png", "/etc/passwd", "a/../../b.png", ""])
def test_transforms_cannot_leave_the_folder(tmp_path, file_path):
    frames = [{"file_path": file_path, "transform_matrix": np.eye(4).tolist()}]
    (tmp_path / "transforms.json").write_text(json.dumps({"fl_x": 30, "frames": frames}))
    with pytest.raises(io.InputError, match=r"transforms\.json: frame 0"):
        io.read_capture(tmp_path)


def test_load_follows_a_new_camera(tmp_path):
    """A localised photograph has a camera of its own; the image is what that camera sees."""
    capture = io.read_capture(make_capture(tmp_path, posed=lambda visit, index: visit == 0))
    photograph = capture.at(1)[0]
    refined = dataclasses.replace(PINHOLE, params=(60.0, 62.0, 16.0, 12.0))
    camera = refined.camera(SE3.identity())
    image = io.load_image(dataclasses.replace(photograph, camera=camera))
    plain = io.load_image(photograph)
    # Twice the focal length shows the middle half.
    np.testing.assert_allclose(image[0, 0], plain[6, 8] * 0.75**2 + 0 * image[0, 0], atol=1)
    assert np.abs(image - plain).max() > 0.1


def test_real_captures(shared):
    capture = io.read_capture(shared / "captures" / "livingroom")
    assert len(capture.photographs) == 68 and sum(p.camera is not None for p in capture.photographs) == 36
    seen = capture.point_observations
    for index in np.unique(seen.photographs)[::9]:
        mine = seen.photographs == index
        camera = capture.photographs[index].camera
        pixels = np.asarray(camera.project(capture.points.astype(np.float32))[0])[seen.points[mine]]
        # The observations are in the distorted photograph, 0.005 of distortion is a pixel or two at its corners.
        assert np.median(np.linalg.norm(pixels - seen.pixels[mine], axis=1)) < 2
    assert io.load_mask(capture.photographs[0]).mean() == pytest.approx(0.93, abs=0.01)
    desk = io.read_capture(shared / "captures" / "desk")
    assert [len(desk.at(t, "test")) for t in range(4)] == [6, 6, 6, 6]
    assert [len(desk.at(t, "update")) for t in range(1, 4)] == [3, 3, 3]
