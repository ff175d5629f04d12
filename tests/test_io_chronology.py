"""Chronologies and tracks on disk."""

import copy
import json
import os
import struct

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import safetensors.numpy

from ltgs_jax import io
from ltgs_jax.geometry import SE3
from ltgs_jax.scene import Chronology, Shadows, Splats, Template, compose, ground_layers


def make_splats(rng, n: int, k: int, dtype) -> Splats:
    shapes = ((n, 3), (n, 4), (n, 3), (n,), (n, k, 3))
    return Splats(*(jnp.asarray(rng.normal(size=shape), dtype) for shape in shapes))


def make_chronology(*, templates: int = 2, dtype=jnp.float32) -> Chronology:
    rng = np.random.default_rng(0)
    t = 3
    return Chronology(
        background=make_splats(rng, 11, 4, dtype),
        templates=tuple(Template(make_splats(rng, i, 1 if i else 16, dtype), 10 + i, i % t) for i in range(templates)),
        world_from_template=SE3(
            jnp.asarray(rng.normal(size=(t, templates, 4)), dtype),
            jnp.asarray(rng.normal(size=(t, templates, 3)), dtype),
        ),
        visible=jnp.asarray(rng.random((t, templates)) < 0.5),
        exposure=jnp.asarray(rng.normal(size=(2, 3, 2)), dtype),
        visits=("a", "IMG_0001", "ü"),
        photographs=("a/000.png", "IMG_0001/x y.jpg"),
        since=jnp.asarray([0] * 8 + [1, 1, 2], jnp.int32) if templates else None,
        shade=jnp.asarray(rng.normal(size=(t, templates, 4)), dtype) if templates > 1 else None,
        shadows=_shadows(rng, t, dtype) if templates > 1 else None,
    )


def _shadows(rng, t: int, dtype) -> Shadows:
    blobs = (jnp.asarray(rng.normal(size=shape), dtype) for shape in ((5, 3), 5, 5))
    return Shadows(*blobs, jnp.asarray(rng.random((t, 5)) < 0.5))


def assert_same(a: Chronology, b: Chronology) -> None:
    assert jax.tree.structure(a) == jax.tree.structure(b)
    for left, right in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        assert left.dtype == right.dtype
        np.testing.assert_array_equal(left, right)


@pytest.mark.parametrize("precision, bound, bytes_of_splat", [("half", 2**-11, 12 + 2 * 20), ("8-bit", 0, 12 + 20)])
def test_a_smaller_file_is_as_near_as_its_precision_allows(tmp_path, precision, bound, bytes_of_splat):
    chronology = make_chronology()
    io.save_chronology(tmp_path, chronology, precision=precision)
    read = io.load_chronology(tmp_path)
    before, after = chronology.background, read.background
    np.testing.assert_array_equal(after.means, before.means)
    for name in ("quats", "log_scales", "logit_opacities", "sh"):
        a, b = np.asarray(getattr(before, name)), np.asarray(getattr(after, name))
        assert b.dtype == np.float32
        assert (np.abs(b - a) <= bound * np.abs(a) + (0 if bound else np.ptp(a, axis=0) / 500)).all()
        assert (a != b).any()
    rest = eqx.tree_at(lambda c: (c.background, c.templates), read, (chronology.background, chronology.templates))
    assert_same(chronology, rest)
    arrays = safetensors.numpy.load((tmp_path / "chronology.safetensors").read_bytes())
    stored = [a.nbytes for key, a in arrays.items() if key.startswith("background.") and not key.endswith("range")]
    assert sum(stored) == 11 * bytes_of_splat + 3 * 8  # and in three runs since when they show
    with pytest.raises(ValueError, match="precision: expected one of full, half, 8-bit"):
        io.save_chronology(tmp_path, chronology, precision="4-bit")


@pytest.mark.parametrize("templates", [0, 1, 4])
def test_round_trip_is_exact(tmp_path, templates):
    chronology = make_chronology(templates=templates)
    io.save_chronology(tmp_path, chronology)
    read = io.load_chronology(tmp_path)
    assert_same(chronology, read)
    np.testing.assert_array_equal(compose(read, 1).means, compose(chronology, 1).means)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["chronology.json", "chronology.safetensors"]
    description = json.loads((tmp_path / "chronology.json").read_text())
    assert description["visits"] == ["a", "IMG_0001", "ü"] and len(description["templates"]) == templates


@pytest.mark.parametrize("precision", ["full", "half", "8-bit"])
def test_colours_that_depend_on_no_direction_take_no_bytes(tmp_path, precision):
    chronology = make_chronology()
    flat = chronology.background.sh.at[8:, 1:].set(0).at[2, 1:].set(0)
    chronology = eqx.tree_at(lambda c: c.background.sh, chronology, flat)
    io.save_chronology(tmp_path, chronology, precision=precision)
    arrays = safetensors.numpy.load((tmp_path / "chronology.safetensors").read_bytes())
    assert arrays["background.sh"].shape == (11, 1, 3) and arrays["background.sh_rest"].shape == (8, 3, 3)
    read = io.load_chronology(tmp_path)
    assert not np.asarray(read.background.sh[8:, 1:]).any()
    if precision == "full":
        assert_same(chronology, read)


def test_a_file_of_the_first_version_is_read(tmp_path):
    chronology = make_chronology()
    io.save_chronology(tmp_path, chronology)
    path = tmp_path / "chronology.safetensors"
    arrays = safetensors.numpy.load(path.read_bytes())
    for rest in [key for key in arrays if key.endswith("sh_rest")]:
        arrays[rest[:-5]] = np.concatenate([arrays[rest[:-5]], arrays.pop(rest)], axis=1)
    del arrays["background.since_runs"]
    arrays["background.since"] = np.asarray(chronology.since, np.uint8)
    description = (tmp_path / "chronology.json").read_text()
    path.write_bytes(safetensors.numpy.save(arrays, {"chronology": description}))
    rewrite(path, lambda d: d.update(version=1))
    assert_same(chronology, io.load_chronology(tmp_path))


def test_ground_shows_from_the_visit_that_brought_it_to_light():
    chronology = make_chronology(templates=1)
    shown = [np.isfinite(np.asarray(compose(chronology, t).logit_opacities[:11])) for t in range(3)]
    assert [int(s.sum()) for s in shown] == [8, 10, 11]
    layers = ground_layers(chronology)
    assert {t: splats.count for t, splats in layers.items()} == {0: 8, 1: 2, 2: 1}
    np.testing.assert_array_equal(layers[1].means, chronology.background.means[8:10])
    assert ground_layers(make_chronology(templates=0))[0].count == 11


def test_float64_stays(tmp_path):
    with jax.enable_x64(True):
        chronology = make_chronology(dtype=jnp.float64)
        io.save_chronology(tmp_path, chronology)
        assert_same(chronology, io.load_chronology(tmp_path))


def test_untouched_chronology_of_one_scene(tmp_path):
    chronology = Chronology.of_initial(make_splats(np.random.default_rng(0), 3, 1, jnp.float32), ("a", "b"))
    io.save_chronology(tmp_path, chronology)
    assert_same(chronology, io.load_chronology(tmp_path))


def test_cut_anywhere_is_named(tmp_path):
    io.save_chronology(tmp_path, make_chronology())
    path = tmp_path / "chronology.safetensors"
    whole = path.read_bytes()
    for length in [*range(0, len(whole), max(1, len(whole) // 60)), len(whole) - 1]:
        path.write_bytes(whole[:length])
        with pytest.raises(io.InputError, match=r"chronology\.safetensors"):
            io.load_chronology(tmp_path)


def test_hostile_header_length(tmp_path):
    for head in (struct.pack("<Q", 2**63), struct.pack("<Q", 2**40), b"\xff" * 8):
        (tmp_path / "chronology.safetensors").write_bytes(head + b"{}" + b" " * 100)
        with pytest.raises(io.InputError, match="cut short"):
            io.load_chronology(tmp_path)


def rewrite(path, change) -> None:
    """The file with its description changed."""
    whole = path.read_bytes()
    length = struct.unpack("<Q", whole[:8])[0]
    header = json.loads(whole[8 : 8 + length])
    description = json.loads(header["__metadata__"]["chronology"])
    change(description)
    header["__metadata__"]["chronology"] = json.dumps(description)
    text = json.dumps(header).encode()
    path.write_bytes(struct.pack("<Q", len(text)) + text + whole[8 + length :])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d.update(version=3), "version 3; this program reads versions 1 and 2"),
        (lambda d: d.update(visits=["a"]), "expected float32"),
        (lambda d: d.update(visits=["a", "../b", "c"]), r"'\.\./b' is not a name inside"),
        (lambda d: d.update(photographs=["/etc/passwd", "x"]), "is not a name inside"),
        (lambda d: d.update(visits=[]), "does not describe"),
        (lambda d: d.update(visits=[1, 2, 3]), "does not describe"),
        (lambda d: d["templates"].pop(), "expected float32"),
        (lambda d: d["templates"][0].update(splats=10**12), "expected float32"),
        (lambda d: d["templates"][0].pop("identity"), "does not describe"),
        (lambda d: d.update(background_splats=True), "does not describe"),
    ],
)
def test_descriptions_that_do_not_fit(tmp_path, change, message):
    io.save_chronology(tmp_path, make_chronology())
    rewrite(tmp_path / "chronology.safetensors", change)
    with pytest.raises(io.InputError, match=message) as caught:
        io.load_chronology(tmp_path)
    assert "\n" not in str(caught.value)


def test_unwritable_folder_is_named(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(io.InputError, match="cannot be written"):
        io.save_chronology(tmp_path / "file" / "run", make_chronology())


# --- tracks and JSON ---

STATE = {
    "visit": 1,
    "event": "moved",
    "visible": True,
    "world_from_template": {"wxyz": [1, 0, 0, 0], "xyz": [0, 0, 0]},
    "confidence": 0.97,
    "inliers": 143,
    "residual": 0.004,
    "ambiguous_axis": None,
}
TRACKS = {
    "visits": ["IMG_0000", "IMG_0001"],
    "photographs": [{"name": "IMG_0001/000.png", "status": "localized", "inliers": 212, "reason": None}],
    "objects": [
        {"id": 1, "source_visit": 0, "splats": 812, "center": [0.1, 0.2, 0.7], "size": 0.21, "states": [STATE]},
    ],
}


def test_tracks_return_with_arrays_as_lists(tmp_path):
    tracks = copy.deepcopy(TRACKS)
    state = tracks["objects"][0]["states"][0]
    state["world_from_template"]["xyz"] = jnp.zeros(3)
    state["inliers"], state["residual"] = np.int64(5), float("inf")
    io.write_tracks(tmp_path / "tracks.json", **tracks)
    read = io.read_tracks(tmp_path / "tracks.json")
    assert read["objects"][0]["states"][0] == STATE | {"inliers": 5, "residual": None}


@pytest.mark.parametrize(
    ("place", "value", "message"),
    [
        (("objects", 0, "states", 0, "event"), "vanished", r"objects\[0\]\.states\[0\]\.event: expected one of still"),
        (("objects", 0, "states", 0, "confidence"), 1.5, "confidence: 1.5 is out of range"),
        (("objects", 0, "states", 0, "visible"), 1, "visible: expected boolean"),
        (("objects", 0, "states", 0, "world_from_template"), {"wxyz": [1, 0, 0, 0]}, "has no xyz"),
        (("objects", 0, "center"), [0, 0], "center: has 2 entries"),
        (("objects", 0, "id"), True, "id: expected integer"),
        (("photographs", 0, "status"), "lost", "status: expected one of given"),
        (("visits",), [], "visits: has 0 entries"),
    ],
)
def test_tracks_that_break_the_schema(tmp_path, place, value, message):
    tracks = copy.deepcopy(TRACKS)
    inner = tracks
    for key in place[:-1]:
        inner = inner[key]
    inner[place[-1]] = value
    with pytest.raises(ValueError, match=message):
        io.write_tracks(tmp_path / "tracks.json", **tracks)
    assert not (tmp_path / "tracks.json").exists()
    io.write_json(tmp_path / "tracks.json", {"version": 1, **tracks})
    with pytest.raises(io.InputError, match=message):
        io.read_tracks(tmp_path / "tracks.json")


def test_json_is_strict_and_readable_by_others(tmp_path):
    path = tmp_path / "deep" / "metrics.json"
    io.write_json(path, {"a": np.float32(1.5), "b": [np.nan, np.inf, True], "c": path, 4: jnp.arange(3)})
    assert json.loads(path.read_text()) == {"a": 1.5, "b": [None, None, True], "c": str(path), "4": [0, 1, 2]}
    assert path.stat().st_mode & 0o777 == 0o666 & ~_umask()


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


@pytest.mark.parametrize("text", ["", "{", "[" * 100000, '{"a": NaN}x', "\xff", "[]"])
def test_broken_json_is_named(tmp_path, text):
    (tmp_path / "a.json").write_bytes(text.encode("latin-1"))
    with pytest.raises(io.InputError, match=r"a\.json"):
        io.read_json(tmp_path / "a.json")
