"""The converters of foreign data sets into captures."""

import json

import numpy as np
import OpenImageIO as oiio
import pytest

from experiments import convert_livingroom, convert_paslcd, convert_redkitchen
from ltgs_jax import io
from ltgs_jax.io.colmap import ColmapImage, ColmapModel
from ltgs_jax.io.lens import CameraModel


def test_paslcd_keeps_poses_under_new_names(tmp_path):
    source, out = tmp_path / "source", tmp_path / "out"
    names = [f"{prefix}_{i}.jpeg" for prefix in ("inference", "inst1", "inst2") for i in range(2)]
    none = np.zeros((0, 2)), np.zeros(0, np.int64)
    images = {}
    for i, name in enumerate(names):
        io.write_image(source / name, np.full((12, 16, 3), i / 10))
        if name != "inst2_1.jpeg":
            images[i + 1] = ColmapImage(name, 1, np.array([1.0, 0, 0, 0]), np.array([i, 0.0, 0.0]), *none)
    lens = CameraModel("SIMPLE_RADIAL", 16, 12, (20.0, 8.0, 6.0, 0.01))
    empty = np.zeros((0, 3))
    model = ColmapModel(
        {1: lens}, images, np.zeros(0, int), empty, empty.astype(np.uint8), np.zeros(0), np.zeros((0, 3), int)
    )
    io.write_colmap(source / "sparse" / "0", model)
    convert_paslcd.convert(source, out)
    capture = io.read_capture(out)
    assert [p.path.name[:5] for p in capture.photographs] == ["inst1"] * 2 + ["inst2"] * 2 + ["infer"] * 2
    xs = [None if p.camera is None else float(p.camera.cam_from_world.xyz[0]) for p in capture.photographs]
    assert xs == [2, 3, 4, None, 0, 1]
    assert [p.role for p in capture.photographs] == ["train"] * 2 + ["update"] * 4
    with pytest.raises(io.InputError, match="already holds"):
        convert_paslcd.convert(source, out)
    with pytest.raises(io.InputError, match="has no inst1"):
        convert_paslcd.convert(tmp_path, tmp_path / "other")


def test_frames_of_the_living_room_are_scored_from_their_own_cameras(tmp_path):
    source, out = tmp_path / "source", tmp_path / "out"
    none = np.zeros((0, 2)), np.zeros(0, np.int64)
    lens = CameraModel("SIMPLE_RADIAL", 16, 12, (20.0, 8.0, 6.0, 0.0))
    images = {1: ColmapImage("IMG_0000/0000.jpg", 1, np.array([1.0, 0, 0, 0]), np.zeros(3), *none)}
    for name in ("images/IMG_0000/0000.jpg", "images/IMG_0001/0000.jpg", "reference/IMG_0001/0042.jpg"):
        io.write_image(source / name, np.full((12, 16, 3), 0.5))
    io.write_labels(source / "masks" / "IMG_0000" / "0000.jpg.png", np.full((12, 16), 255))
    pose = {"wxyz": [1, 0, 0, 0], "xyz": [7, 0, 0], "model": lens.model, "width": 16, "height": 12}
    poses = {"IMG_0001/0042.jpg": {**pose, "params": list(lens.params)}}
    (source / "reference" / "poses.json").write_text(json.dumps(poses))
    empty = np.zeros((0, 3))
    model = ColmapModel(
        {1: lens}, images, np.zeros(0, int), empty, empty.astype(np.uint8), np.zeros(0), np.zeros((0, 3), int)
    )
    io.write_colmap(source / "sparse" / "0", model)
    convert_livingroom.convert(source, out)
    photographs = {p.name: p for p in io.read_capture(out).photographs}
    frame = photographs["IMG_0001/reference_0042.jpg"]
    assert {name: p.role for name, p in photographs.items()} == {
        "IMG_0000/0000.jpg": "test",
        "IMG_0001/0000.jpg": "update",
        frame.name: "test",
    }
    assert float(frame.camera.cam_from_world.xyz[0]) == 7
    assert frame.mask_path is not None
    with pytest.raises(io.InputError, match="already holds"):
        convert_livingroom.convert(source, out)


def test_redkitchen_points_lie_on_the_depth(tmp_path):
    """Three cameras that slide along a wall 2 m away, whose colour is a function of the place on it."""
    source, out = tmp_path / "source" / "data", tmp_path / "out"
    source.mkdir(parents=True)
    np.savetxt(source / "camera-intrinsics.txt", [[40, 0, 19.5], [0, 40, 14.5], [0, 0, 1]])
    column, row = np.meshgrid(np.arange(40), np.arange(30))
    for i in range(3):
        pose = np.eye(4)
        pose[0, 3] = 0.2 * i
        np.savetxt(source / f"frame-{i:06d}.pose.txt", pose)
        x, y = (column - 19.5) / 40 * 2 + 0.2 * i, (row - 14.5) / 40 * 2
        color = np.stack([0.5 + 0.3 * x, 0.5 + 0.3 * y, 0.5 + 0 * x], axis=-1)
        io.write_image(source / f"frame-{i:06d}.color.png", color)
        io.write_labels(source / f"frame-{i:06d}.depth.png", np.full((30, 40), 2000))
    convert_redkitchen.convert(source.parent, out, points=100)
    capture = io.read_capture(out)
    np.testing.assert_allclose(capture.points[:, 2], 2, atol=1e-9)
    expected = np.clip(np.column_stack([0.5 + 0.3 * capture.points[:, :2], np.full(100, 0.5)]), 0, 1)
    np.testing.assert_allclose(capture.point_colors, expected, atol=1.1 / 255)
    assert np.bincount(capture.point_observations.points).min() == 3
    np.testing.assert_allclose(capture.photographs[2].camera.center(), [0.4, 0, 0], atol=1e-6)
    np.testing.assert_allclose(capture.photographs[0].camera.K[:2, 2], [20, 15])


def test_pixels_keep_their_type(tmp_path):
    output = oiio.ImageOutput.create(str(tmp_path / "a.png"))
    values = np.array([[[0], [40000], [65535]]], np.uint16)
    assert output.open(str(tmp_path / "a.png"), oiio.ImageSpec(3, 1, 1, "uint16"))
    assert output.write_image(values) and output.close()
    np.testing.assert_array_equal(io.read_pixels(tmp_path / "a.png"), values)
