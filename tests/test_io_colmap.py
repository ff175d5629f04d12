"""COLMAP models and lenses, against pycolmap and OpenCV."""

import struct
import zlib  # noqa: F401  before pycolmap, whose own copy would otherwise be taken

import cv2
import numpy as np
import pycolmap
import pytest

from ltgs_jax import io
from ltgs_jax.io import lens as lenses
from ltgs_jax.io.colmap import ColmapImage, ColmapModel
from ltgs_jax.io.lens import CameraModel

LENSES = [
    CameraModel("SIMPLE_PINHOLE", 64, 48, (50.0, 31.0, 25.0)),
    CameraModel("PINHOLE", 64, 48, (50.0, 52.0, 31.0, 25.0)),
    CameraModel("SIMPLE_RADIAL", 64, 48, (50.0, 31.0, 25.0, -0.12)),
    CameraModel("RADIAL", 64, 48, (50.0, 31.0, 25.0, -0.12, 0.03)),
    CameraModel("OPENCV", 64, 48, (50.0, 52.0, 31.0, 25.0, -0.12, 0.03, 0.004, -0.006)),
]


def make_model(seed: int = 0, *, space: str = "_") -> ColmapModel:
    """Two registered images of each lens, eight points seen by some of them."""
    rng = np.random.default_rng(seed)
    images, track = {}, []
    for identity in range(1, 11):
        quat = rng.normal(size=4)
        seen = np.flatnonzero(rng.random(8) < 0.5)
        ids = np.concatenate([seen + 20, [-1]])
        pixels = rng.uniform(0, 48, size=(len(ids), 2))
        name = f"IMG_000{identity % 2}/a{space}picture{space}{identity}.png"
        xyz = rng.normal(size=3)
        images[identity] = ColmapImage(name, (identity - 1) // 2 + 1, quat / np.linalg.norm(quat), xyz, pixels, ids)
        track += [(point, identity, index) for index, point in enumerate(seen)]
    return ColmapModel(
        cameras={index + 1: lens for index, lens in enumerate(LENSES)},
        images=images,
        point_ids=np.arange(20, 28),
        points=rng.normal(size=(8, 3)),
        colors=rng.integers(0, 256, (8, 3)).astype(np.uint8),
        errors=rng.random(8),
        track=np.array(sorted(track)),
    )


def assert_same(a: ColmapModel, b: ColmapModel) -> None:
    assert a.cameras == b.cameras
    assert a.images.keys() == b.images.keys()
    for identity, image in a.images.items():
        other = b.images[identity]
        assert (image.name, image.camera_id) == (other.name, other.camera_id)
        np.testing.assert_allclose(image.quat * np.sign(image.quat[0]), other.quat * np.sign(other.quat[0]), atol=1e-12)
        np.testing.assert_allclose(image.xyz, other.xyz, atol=1e-12)
        np.testing.assert_allclose(image.pixels, other.pixels, atol=1e-12)
        np.testing.assert_array_equal(image.point_ids, other.point_ids)
    a_order, b_order = np.argsort(a.point_ids), np.argsort(b.point_ids)
    for field in ("point_ids", "points", "colors"):
        np.testing.assert_allclose(getattr(a, field)[a_order], getattr(b, field)[b_order], atol=1e-12)

    def pairs(model):
        return {(int(model.point_ids[point]), image, index) for point, image, index in model.track.tolist()}

    assert pairs(a) == pairs(b)


def test_text_is_read_back(tmp_path):
    model = make_model(space=" ")
    io.write_colmap(tmp_path, model)
    assert_same(model, io.read_colmap(tmp_path))


def test_pycolmap_reads_what_is_written_and_its_binary_is_read(tmp_path):
    model = make_model()
    io.write_colmap(tmp_path / "text", model)
    theirs = pycolmap.Reconstruction(str(tmp_path / "text"))
    assert theirs.num_points3D() == 8 and theirs.num_images() == 10
    (tmp_path / "binary").mkdir()
    theirs.write_binary(str(tmp_path / "binary"))
    assert_same(model, io.read_colmap(tmp_path / "binary"))


def test_hand_written_images_without_second_lines(tmp_path):
    io.write_colmap(tmp_path, make_model())
    lines = (tmp_path / "images.txt").read_text().splitlines()
    (tmp_path / "images.txt").write_text("# a comment\n" + "\n".join(lines[::2]) + "\n")
    read = io.read_colmap(tmp_path)
    assert len(read.images) == 10 and all(len(image.pixels) == 0 for image in read.images.values())
    assert len(read.track) == 0


@pytest.mark.parametrize("lens", LENSES, ids=lambda lens: lens.model)
def test_distortion_agrees_with_pycolmap(lens):
    camera = pycolmap.Camera(model=lens.model, width=64, height=48, params=list(lens.params))
    ideal = np.random.default_rng(1).uniform(-0.6, 0.6, (50, 2))
    expected = np.array([camera.img_from_cam(np.append(xy, 1.0)) for xy in ideal])
    actual = lenses.distort(lens, ideal) * np.diag(lens.K())[:2] + lens.K()[:2, 2]
    np.testing.assert_allclose(actual, expected, atol=1e-10)


@pytest.mark.parametrize("lens", LENSES, ids=lambda lens: lens.model)
def test_maps_invert_each_other(lens):
    K = lens.K()
    there, back = lenses.undistort_map(lens, K), lenses.distort_map(lens, K)
    inner = there[12:36, 16:48].reshape(-1, 1, 2)
    again = cv2.remap(back, inner, None, cv2.INTER_LINEAR).reshape(-1, 2)
    grid = np.stack(np.meshgrid(np.arange(16, 48), np.arange(12, 36)), axis=-1).reshape(-1, 2)
    np.testing.assert_allclose(again, grid, atol=0.02)


def test_resized_lens_projects_to_scaled_pixels():
    for lens in LENSES:
        for size in ((32, 24), (128, 96), (64, 24)):
            ideal = np.random.default_rng(2).uniform(-0.5, 0.5, (20, 2))
            small = lens.resized(*size)
            pixels = lenses.distort(lens, ideal) * np.diag(lens.K())[:2] + lens.K()[:2, 2]
            scaled = lenses.distort(small, ideal) * np.diag(small.K())[:2] + small.K()[:2, 2]
            np.testing.assert_allclose(scaled, pixels * [size[0] / 64, size[1] / 48], atol=1e-9)


@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
def test_binary_cut_anywhere_is_named(tmp_path, name):
    io.write_colmap(tmp_path / "text", make_model())
    (tmp_path / "binary").mkdir()
    pycolmap.Reconstruction(str(tmp_path / "text")).write_binary(str(tmp_path / "binary"))
    path = tmp_path / "binary" / f"{name}.bin"
    whole = path.read_bytes()
    for length in [*range(0, len(whole), max(1, len(whole) // 40)), len(whole) - 1]:
        path.write_bytes(whole[:length])
        with pytest.raises(io.InputError, match=rf"{name}\.bin"):
            io.read_colmap(tmp_path / "binary")


def test_hostile_counts_do_not_allocate(tmp_path):
    io.write_colmap(tmp_path / "text", make_model())
    binary = tmp_path / "binary"
    binary.mkdir()
    pycolmap.Reconstruction(str(tmp_path / "text")).write_binary(str(binary))
    (binary / "points3D.bin").write_bytes(struct.pack("<Q", 2**63) + b"\0" * 100)
    with pytest.raises(io.InputError, match=r"points3D\.bin.*cut short"):
        io.read_colmap(binary)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("cameras", "1 FISHY 64 48 1 2 3", "FISHY is not read"),
        ("cameras", "1 PINHOLE 64 48 1 2 3", "4 parameters"),
        ("cameras", "1 PINHOLE 64 48 0 0 3 4", "PINHOLE with parameters"),
        ("cameras", "1 PINHOLE 64 -48 9 9 3 4", "64×-48"),
        ("cameras", "1 PINHOLE sixty 48 9 9 3 4", "expected numbers"),
        ("images", "1 1 0 0 0 0 0 0 9 a.png\n", "camera 9"),
        ("images", "1 0 0 0 0 0 0 0 1 a.png\n", "not a pose"),
        ("images", "1 nan 0 0 0 0 0 0 1 a.png\n", "not a pose"),
        ("images", "1 1 0 0 0\n", "expected an image"),
        ("images", "1 1 0 0 0 0 0 0 1 a.png\n1 2\n", "as x, y, point"),
        ("points3D", "1 0 0 inf 1 2 3 0", "expected id"),
        ("points3D", "1 0 0", "expected id"),
    ],
)
def test_text_faults_are_named(tmp_path, name, text, message):
    io.write_colmap(tmp_path, make_model())
    (tmp_path / f"{name}.txt").write_text(text)
    with pytest.raises(io.InputError, match=message) as caught:
        io.read_colmap(tmp_path)
    assert f"{name}.txt" in str(caught.value) and "\n" not in str(caught.value)


def test_identifiers_beyond_any_model_are_no_points(tmp_path):
    io.write_colmap(tmp_path, make_model())
    path = tmp_path / "images.txt"
    path.write_text(path.read_text().replace(" 20\n", " 99999999999999999999\n").replace(" -1\n", " 1e300\n"))
    assert all(np.all(image.point_ids < 28) for image in io.read_colmap(tmp_path).images.values())
    path = tmp_path / "points3D.txt"
    path.write_text(path.read_text() + "99999999999999999999 1 2 3 4 5 6 0 1e300 1e300\n")
    read = io.read_colmap(tmp_path)
    assert len(read.points) == 9 and read.point_ids[-1] == -1 and not np.any(read.track[:, 0] == 8)
