"""What a run can be taken away as, read back by what is independent of the writer."""

import json
import struct
from pathlib import Path

import cv2
import jax.numpy as jnp
import numpy as np
import pytest
from tiny_capture import write_tiny_capture

from ltgs_jax import pipeline
from ltgs_jax.geometry import SE3
from ltgs_jax.io import InputError, load_chronology, read_capture, read_colmap, read_splats, save_chronology, write_json
from ltgs_jax.pipeline.outputs import _camera_json
from ltgs_jax.scene import Chronology, Template, compose, drop_hidden


@pytest.fixture(scope="module")
def finished(tmp_path_factory) -> tuple[Path, Path]:
    """The folder of a chronology as a run leaves it: an object cut out of the scene that moves, then goes."""
    folder = tmp_path_factory.mktemp("exports")
    capture = read_capture(write_tiny_capture(folder / "capture"))
    splats = read_splats(capture.initial_ply)
    start = Chronology.of_initial(splats[:1296], ("t0", "t1", "t2"))
    turn = SE3(jnp.asarray([np.cos(0.4), 0, 0, np.sin(0.4)], jnp.float32), jnp.asarray([0.3, 0.1, 0.0], jnp.float32))
    poses = SE3(
        jnp.stack([SE3.identity((), jnp.float32).quat, turn.quat, turn.quat])[:, None],
        jnp.stack([jnp.zeros(3), turn.xyz, turn.xyz])[:, None],
    )
    visible = jnp.asarray([[True], [True], [False]])
    chronology = Chronology(
        start.background, (Template(splats[1296:], 1, 0),), poses, visible, start.exposure, start.visits
    )
    save_chronology(folder / "out", chronology)
    rows = {p.name: {"visit": p.visit, "role": p.role, **_camera_json(p.camera)} for p in capture.photographs}
    write_json(folder / "out" / "cameras.json", {"capture": str(folder / "capture"), "photographs": rows})
    write_json(folder / "out" / "tracks.json", {"version": 1, "visits": list(chronology.visits), "objects": []})
    return folder / "out", folder / "capture"


@pytest.mark.parametrize("form, tolerance", [("ply", 0), ("compressed-ply", 2e-3), ("spz", 1e-3), ("splat", 0)])
def test_a_visit_as_splats(finished, tmp_path, form, tolerance):
    out, _ = finished
    for visit in (1, 2):
        path = tmp_path / f"visit.{'splat' if form == 'splat' else form.split('-')[-1]}"
        pipeline.export(out, form, path, visit=visit)
        found, meant = read_splats(path), drop_hidden(compose(load_chronology(out), visit))
        assert found.count == meant.count == (1556 if visit == 1 else 1296)
        by_place = [np.sort(np.asarray(s.means), axis=0) for s in (found, meant)]  # a compressed PLY may reorder
        np.testing.assert_allclose(*by_place, atol=tolerance)


@pytest.mark.parametrize("form, tolerance, size", [("chronology-half", 4e-3, 0.7), ("chronology-8bit", 0.05, 0.5)])
def test_all_visits_in_a_smaller_file(finished, tmp_path, form, tolerance, size):
    out, _ = finished
    pipeline.export(out, form, tmp_path / "small")
    whole, small = ((folder / "chronology.safetensors").stat().st_size for folder in (out, tmp_path / "small"))
    assert small < size * whole
    name = next(iter(json.loads((out / "cameras.json").read_text())["photographs"]))
    for visit in (0, 1, 2):
        images = []
        for folder in (out, tmp_path / "small"):
            pipeline.render_visit(folder, visit, name, False, tmp_path / "images")
            images.append(cv2.imread(str((tmp_path / "images" / name).with_suffix(".png"))) / 255)
        assert images[0].std() > 0.02
        assert np.abs(images[0] - images[1]).max() <= tolerance + 1 / 255
    with pytest.raises(InputError, match="is the run's own folder"):
        pipeline.export(out, form, out)


def test_a_sequence_that_players_find(finished, tmp_path):
    out, _ = finished
    pipeline.export(out, "ply-sequence", tmp_path / "room")
    assert sorted(path.name for path in (tmp_path / "room").iterdir()) == [f"room_{t:04d}.ply" for t in range(3)]
    assert [read_splats(tmp_path / "room" / f"room_{t:04d}.ply").count for t in range(3)] == [1556, 1556, 1296]


def test_poses_as_an_animation(finished, tmp_path):
    out, _ = finished
    pipeline.export(out, "gltf", tmp_path / "poses.glb")
    content = (tmp_path / "poses.glb").read_bytes()
    length, kind = struct.unpack_from("<II", content, 12)
    document = json.loads(content[20 : 20 + length])
    assert content[:4] == b"glTF" and kind == 0x4E4F534A
    paths = {channel["target"]["path"] for channel in document["animations"][0]["channels"]}
    assert paths == {"translation", "rotation", "scale"}
    assert document["extras"]["visits"] == ["t0", "t1", "t2"]


def test_cameras_of_all_visits_as_a_colmap_model(finished, tmp_path):
    out, capture = finished
    pipeline.export(out, "colmap", tmp_path / "sparse")
    model, given = read_colmap(tmp_path / "sparse"), read_capture(capture)
    assert sorted(image.name for image in model.images.values()) == sorted(p.name for p in given.photographs)
    poses = {image.name: (image.quat, image.xyz) for image in model.images.values()}
    for p in given.photographs:
        np.testing.assert_allclose(poses[p.name][1], p.camera.cam_from_world.xyz, atol=1e-6)
    assert len(model.points) == len(given.points)


@pytest.mark.parametrize(
    "form, options, says",
    [
        ("jpeg", {"visit": 0}, "--format jpeg: expected one of ply, "),
        ("spz", {}, "--visit: is needed"),
        ("colmap", {"visit": 1}, "--visit: colmap holds all visits"),
        ("gltf", {}, "name a .glb file"),
        ("colmap", {"capture": "nowhere"}, "nowhere: no such folder"),
    ],
)
def test_wrong_options_are_named(finished, tmp_path, form, options, says):
    with pytest.raises(InputError, match=says):
        pipeline.export(finished[0], form, tmp_path / "x", **options)
    assert not list(tmp_path.iterdir())
