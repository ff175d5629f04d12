"""Splat files of other programs, COLMAP and glTF exports."""

import dataclasses
import gzip
import json
import struct
import zlib  # noqa: F401  before pycolmap, whose own copy would otherwise be taken

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pycolmap
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from ltgs_jax import io
from ltgs_jax.geometry import SE3, eval_sh, rotate_sh, sh_degree, sh_rotations
from ltgs_jax.io import compressed_ply, packing
from ltgs_jax.io.ply import read_ply_tables
from ltgs_jax.io.spz import read_spz
from ltgs_jax.scene import Chronology, Splats, Template


def make_splats(count: int = 700, degree: int = 2, seed: int = 0) -> Splats:
    """A scene of a few units with everything within what the formats can hold."""
    rng = np.random.default_rng(seed)
    quats = rng.normal(size=(count, 4))
    return Splats(
        means=jnp.asarray(rng.normal(size=(count, 3)), jnp.float32),
        quats=jnp.asarray(quats / np.linalg.norm(quats, axis=1, keepdims=True), jnp.float32),
        log_scales=jnp.asarray(rng.uniform(-6, -1, (count, 3)), jnp.float32),
        logit_opacities=jnp.asarray(rng.uniform(-4, 4, count), jnp.float32),
        sh=jnp.asarray(rng.uniform(-0.9, 0.9, (count, (degree + 1) ** 2, 3)), jnp.float32),
    )


def angles_deg(a, b) -> np.ndarray:
    rotations = [Rotation.from_quat(np.asarray(q, np.float64)[:, [1, 2, 3, 0]]) for q in (a, b)]
    return np.degrees((rotations[0].inv() * rotations[1]).magnitude())


def order_like(read: Splats, original: Splats) -> Splats:
    """The read splats in the original's order, by nearest position."""
    distances = np.linalg.norm(np.asarray(original.means)[:, None] - np.asarray(read.means)[None], axis=-1)
    nearest = distances.argmin(axis=1)
    assert len(set(nearest.tolist())) == original.count
    return jax.tree.map(lambda leaf: leaf[jnp.asarray(nearest)], read)


# suffix, then the largest errors of position, angle in degrees, log scale, opacity, degree 0, higher degrees
TOLERANCES = [
    (".compressed.ply", 6 / 1023, 0.25, 5 / 1023, 0.6 / 255, 0.02, 0.017),
    (".spz", 0.6 / 4096, 0.25, 0.51 / 16, 0.6 / 255, 0.51 / 255 / 0.15, 0.51 / 128),
    (".splat", 1e-6, 1.5, 1e-6, 0.6 / 255, 0.51 / 255 / 0.28, None),
]


@pytest.mark.parametrize(("suffix", "position", "angle", "scale", "opacity", "dc", "rest"), TOLERANCES)
@pytest.mark.parametrize("degree", [0, 1, 3])
def test_round_trip_within_the_steps_of_the_format(tmp_path, suffix, position, angle, scale, opacity, dc, rest, degree):
    splats = make_splats(degree=degree)
    io.write_splats(tmp_path / f"scene{suffix}", splats)
    read = order_like(io.read_splats(tmp_path / f"scene{suffix}"), splats)
    np.testing.assert_allclose(read.means, splats.means, atol=position)
    assert angles_deg(read.quats, splats.quats).max() < angle
    np.testing.assert_allclose(read.log_scales, splats.log_scales, atol=scale)
    np.testing.assert_allclose(read.opacities, splats.opacities, atol=opacity)
    np.testing.assert_allclose(read.sh[:, 0], splats.sh[:, 0], atol=dc)
    if rest is not None:
        assert read.sh.shape == splats.sh.shape
        np.testing.assert_allclose(read.sh[:, 1:], splats.sh[:, 1:], atol=rest)


@pytest.mark.parametrize("suffix", [".compressed.ply", ".spz", ".splat", ".ply"])
@pytest.mark.parametrize("count", [0, 1, 256, 257])
def test_any_count(tmp_path, suffix, count):
    io.write_splats(tmp_path / f"a{suffix}", make_splats(count, 0))
    assert io.read_splats(tmp_path / f"a{suffix}").count == count


def test_formats_by_name_and_unknown_ones(tmp_path):
    for form, (suffix, _) in io.WRITERS.items():
        io.write_splats(tmp_path / "by_form", make_splats(3, 0), form=form)
        io.write_splats(tmp_path / f"by_suffix{suffix}", make_splats(3, 0))
        assert (tmp_path / "by_form").read_bytes() == (tmp_path / f"by_suffix{suffix}").read_bytes()
    for name, form in (("a.obj", None), ("a.ply", "obj")):
        with pytest.raises(io.InputError, match="expected one of ply, compressed-ply, spz, splat"):
            io.write_splats(tmp_path / name, make_splats(3, 0), form=form)
    (tmp_path / "a.obj").write_bytes(b"v 0 0 0")
    with pytest.raises(io.InputError, match=r"a\.obj: is no splat file"):
        io.read_splats(tmp_path / "a.obj")


def test_quaternions_of_ten_bits_are_read_as_written_by_hand():
    """One component at a time: a turn of 60° about x, its largest component w in place 0."""
    w, x = np.cos(np.pi / 6), np.sin(np.pi / 6)
    field = round((x / np.sqrt(2) + 0.5) * 1023)
    middle = 511
    packed = np.array([0 << 30 | field << 20 | middle << 10 | middle], np.uint32)
    np.testing.assert_allclose(packing.unpack_quats_10(packed)[0], [w, x, 0, 0], atol=1.5e-3)
    size = round(x * np.sqrt(2) * 511)
    packed = np.array([3 << 30 | (1 << 9 | size) << 20], np.uint32)
    np.testing.assert_allclose(packing.unpack_quats_sign9(packed)[0], [-x, 0, 0, w], atol=1.5e-3)


@pytest.mark.parametrize("pack", ["10", "sign9"])
def test_packed_quaternions_return(pack):
    quats = np.random.default_rng(0).normal(size=(5000, 4))
    quats = np.concatenate([quats, np.eye(4), -np.eye(4), np.full((1, 4), 0.5), np.zeros((1, 4))])
    back = getattr(packing, f"unpack_quats_{pack}")(getattr(packing, f"pack_quats_{pack}")(quats))
    expected = np.where(np.any(quats, axis=1, keepdims=True), quats, [1, 0, 0, 0])
    assert angles_deg(back, expected).max() < 0.25


def test_spz_turns_axes_and_harmonics_together(tmp_path):
    """A splat seen along a direction has the colour that it had, in the turned frame: half a turn about x."""
    splats = make_splats(40, 3)
    io.write_splats(tmp_path / "a.spz", splats)
    content = gzip.decompress((tmp_path / "a.spz").read_bytes())
    magic, version, count, degree, bits, flags, reserved = struct.unpack_from("<4sIIBBBB", content)
    assert (magic, version, count, degree, flags, reserved) == (b"NGSP", 3, 40, 3, 0, 0)
    stored = np.frombuffer(content, np.uint8, 40 * 9, 16).reshape(40, 3, 3).astype(np.int64)
    fixed = stored[..., 0] | stored[..., 1] << 8 | stored[..., 2] << 16
    positions = np.where(fixed >= 1 << 23, fixed - (1 << 24), fixed) / 2.0**bits
    np.testing.assert_allclose(positions, np.asarray(splats.means) * [1, -1, -1], atol=1.5e-4)
    bytes_of_rest = np.frombuffer(content, np.uint8, 40 * 45, 16 + 40 * (9 + 1 + 3 + 3 + 4)).reshape(40, 15, 3)
    turned = np.concatenate([np.asarray(splats.sh[:, :1]), (bytes_of_rest / 128.0) - 1], axis=1)
    direction = np.array([0.6, -0.64, 0.48])
    there = eval_sh(jnp.asarray(turned, jnp.float32), jnp.asarray(direction * [1, -1, -1], jnp.float32))
    here = eval_sh(splats.sh, jnp.asarray(direction, jnp.float32))
    np.testing.assert_allclose(there, here, atol=0.03)
    assert (
        np.abs(
            rotate_sh(splats.sh, sh_rotations(jnp.diag(jnp.array([1.0, -1, -1])), sh_degree(splats.sh))) - splats.sh
        ).max()
        > 0.5
    )


def test_spz_of_version_2(tmp_path):
    """Rotations as three signed bytes, by hand."""
    w, x, y, z = np.array([0.8, 0.4, -0.4, 0.2]) / np.linalg.norm([0.8, 0.4, -0.4, 0.2])
    body = struct.pack("<4sIIBBBB", b"NGSP", 2, 1, 0, 8, 0, 0)
    body += b"".join(int(v * 256).to_bytes(3, "little", signed=True) for v in (1.5, -2, 3))
    body += bytes([128]) + bytes([255, 128, 0]) + bytes([160, 144, 128])
    body += bytes(round((v + 1) * 127.5) for v in (x, y, z))
    (tmp_path / "a.spz").write_bytes(gzip.compress(body))
    splats = read_spz(tmp_path / "a.spz")
    np.testing.assert_allclose(splats.means, [[1.5, 2, -3]])
    np.testing.assert_allclose(splats.log_scales, [[0, -1, -2]])
    np.testing.assert_allclose(splats.quats, [[w, x, -y, -z]], atol=0.01)
    np.testing.assert_allclose(splats.opacities, [128 / 255], atol=1e-6)
    np.testing.assert_allclose(splats.sh[0, 0], [0.5 / 0.15, 0.5 / 255 / 0.15, -0.5 / 0.15], atol=1e-6)


def test_spz_refuses_what_it_cannot_hold(tmp_path):
    splats = make_splats(3, 0)
    far = Splats(splats.means.at[0, 0].set(5000.0), splats.quats, splats.log_scales, splats.logit_opacities, splats.sh)
    with pytest.raises(io.InputError, match=r"far\.spz.*±2048"):
        io.write_splats(tmp_path / "far.spz", far)


def test_compressed_ply_without_colour_bounds(tmp_path):
    """The first version of the format had none: colours are then in 0..1 as they are."""
    splats = make_splats(300, 0)
    io.write_splats(tmp_path / "new.compressed.ply", splats)
    tables = read_ply_tables(tmp_path / "new.compressed.ply")
    old = tables["chunk"][[n for n in tables["chunk"].dtype.names if n[-2:] not in ("_r", "_g", "_b")]]
    read = compressed_ply.splats_of_chunks({"chunk": old, "vertex": tables["vertex"]}, "old.ply")
    color = tables["vertex"]["packed_color"]
    np.testing.assert_allclose(packing.color_of_sh(read.sh[:, 0])[:, 0], (color >> 24) / 255, atol=1e-6)


def test_two_programs_agree_about_one_scene(shared):
    """The same scene as a compressed PLY and as SPZ, written by other people's programs, in the same order."""
    pytest.importorskip("zstandard")
    a = io.read_splats(shared / "splats" / "biker.compressed.ply")
    b = io.read_splats(shared / "splats" / "biker.spz")
    assert a.count == b.count == 152746
    assert np.median(np.abs(a.means - b.means)) < 1 / 4096
    assert np.median(np.abs(a.log_scales - b.log_scales)) < 1 / 32
    assert np.median(np.abs(a.sh - b.sh)) < 0.5 / 255 / 0.15
    assert np.median(np.abs(a.opacities - b.opacities)) < 1 / 255
    assert np.median(angles_deg(a.quats, b.quats)) < 0.15


# --- COLMAP and glTF ---


def test_export_colmap_holds_every_camera(tmp_path):
    from test_io_capture import make_capture

    make_capture(tmp_path / "capture", posed=lambda visit, index: visit == 0)
    capture = io.read_capture(tmp_path / "capture")
    pose = SE3(jnp.array([0.5, 0.5, -0.5, 0.5]), jnp.array([1.0, 2, 3]))
    placed = dataclasses.replace(capture.photographs[-1], camera=capture.photographs[-1].camera_model.camera(pose))
    capture = dataclasses.replace(capture, photographs=(*capture.photographs[:-1], placed))
    io.export_colmap(tmp_path / "model", capture)
    theirs = pycolmap.Reconstruction(str(tmp_path / "model"))
    assert theirs.num_images() == 17 and theirs.num_points3D() == 1
    image = theirs.find_image_with_name("IMG_0002/001.png")
    np.testing.assert_allclose(image.cam_from_world().translation, [1, 2, 3])
    np.testing.assert_allclose(image.cam_from_world().rotation.matrix(), pose.rotmat(), atol=1e-6)
    (point,) = theirs.points3D.values()
    assert len(point.track.elements) == 2
    again = io.read_colmap(tmp_path / "model")
    np.testing.assert_allclose(
        again.images[1].quat,
        np.asarray(capture.photographs[0].camera.cam_from_world.quat)
        / np.linalg.norm(capture.photographs[0].camera.cam_from_world.quat),
        atol=1e-6,
    )


def make_chronology() -> Chronology:
    rng = np.random.default_rng(0)
    quats = rng.normal(size=(3, 2, 4))
    return Chronology(
        background=make_splats(120, 1),
        templates=(Template(make_splats(5, 0, 1), 4, 0), Template(make_splats(6, 0, 2), 7, 1)),
        world_from_template=SE3(jnp.asarray(quats, jnp.float32), jnp.asarray(rng.normal(size=(3, 2, 3)), jnp.float32)),
        visible=jnp.array([[True, False], [True, True], [False, True]]),
        exposure=jnp.zeros((0, 3, 2)),
        visits=("a", "b", "c"),
    )


def read_glb(path) -> tuple[dict, bytes]:
    content = path.read_bytes()
    magic, version, length = struct.unpack_from("<4sII", content)
    assert (magic, version, length) == (b"glTF", 2, len(content))
    size, kind = struct.unpack_from("<I4s", content, 12)
    assert kind == b"JSON" and size % 4 == 0
    return json.loads(content[20 : 20 + size]), content[28 + size :]


def test_gltf_plays_the_poses(tmp_path):
    chronology = make_chronology()
    io.write_gltf(tmp_path / "poses.glb", chronology, most_background=50)
    document, binary = read_glb(tmp_path / "poses.glb")

    def values(index):
        accessor = document["accessors"][index]
        view = document["bufferViews"][accessor["bufferView"]]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
        return np.frombuffer(binary, "<f4", accessor["count"] * width, view["byteOffset"]).reshape(-1, width)

    assert [node["name"] for node in document["nodes"]] == ["background", "object_0004", "object_0007"]
    (animation,) = document["animations"]
    tracks = {}
    for channel in animation["channels"]:
        sampler = animation["samplers"][channel["sampler"]]
        np.testing.assert_array_equal(values(sampler["input"])[:, 0], [0, 1, 2])
        tracks[channel["target"]["node"], channel["target"]["path"]] = values(sampler["output"])
    for k, node in enumerate((1, 2)):
        np.testing.assert_allclose(tracks[node, "translation"], chronology.world_from_template.xyz[:, k])
        rotations = Rotation.from_quat(tracks[node, "rotation"]).as_matrix()
        np.testing.assert_allclose(rotations, chronology.world_from_template[:, k].rotmat(), atol=1e-5)
        assert np.all(np.sum(tracks[node, "rotation"][1:] * tracks[node, "rotation"][:-1], axis=1) >= 0)
        np.testing.assert_array_equal(tracks[node, "scale"][:, 0], chronology.visible[:, k])
    positions = values(document["meshes"][1]["primitives"][0]["attributes"]["POSITION"])
    np.testing.assert_array_equal(positions, chronology.templates[0].splats.means)
    scene = trimesh.load(tmp_path / "poses.glb")
    assert sum(len(g.vertices) for g in scene.geometry.values()) == 40 + 5 + 6


def test_gltf_shows_ground_from_its_visit_on(tmp_path):
    chronology = make_chronology()
    since = np.r_[np.zeros(chronology.background.count - 3, np.int32), [2, 2, 2]].astype(np.int32)
    late = eqx.tree_at(lambda c: c.since, chronology, since, is_leaf=lambda leaf: leaf is None)
    io.write_gltf(tmp_path / "ground.glb", late)
    document, _ = read_glb(tmp_path / "ground.glb")
    names = [node["name"] for node in document["nodes"]]
    assert names[:2] == ["background", f"background_from_{chronology.visits[2]}"]
    assert document["nodes"][1]["scale"] == [0, 0, 0]
    assert {"node": 1, "path": "scale"} in [channel["target"] for channel in document["animations"][0]["channels"]]


def test_gltf_of_a_scene_in_which_nothing_happened(tmp_path):
    io.write_gltf(tmp_path / "a.glb", Chronology.of_initial(make_splats(3, 0), ("a",)))
    document, _ = read_glb(tmp_path / "a.glb")
    assert "animations" not in document and len(document["nodes"]) == 1
