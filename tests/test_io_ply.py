"""Splat scenes as Inria PLY."""

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from ltgs_jax import io
from ltgs_jax.scene import Splats

FIELDS = ("means", "quats", "log_scales", "logit_opacities", "sh")


def make_splats(count: int = 7, degree: int = 2, seed: int = 0) -> Splats:
    rng = np.random.default_rng(seed)
    shapes = ((count, 3), (count, 4), (count, 3), (count,), (count, (degree + 1) ** 2, 3))
    return Splats(*(jnp.asarray(rng.normal(size=shape), jnp.float32) for shape in shapes))


def assert_equal(a: Splats, b: Splats) -> None:
    for field in FIELDS:
        np.testing.assert_array_equal(getattr(a, field), getattr(b, field))


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("count", [0, 1, 1000])
def test_round_trip_is_exact(tmp_path, degree, count):
    splats = make_splats(count, degree)
    io.write_ply(tmp_path / "scene.ply", splats)
    assert_equal(io.read_ply(tmp_path / "scene.ply"), splats)


def test_layout_is_inrias(tmp_path):
    splats = make_splats(5, 3)
    io.write_ply(tmp_path / "scene.ply", splats)
    properties = [line.split()[2] for line in (tmp_path / "scene.ply").read_bytes().split(b"\n") if b"property" in line]
    expected = ["x", "y", "z", "nx", "ny", "nz", *(f"f_dc_{i}" for i in range(3)), *(f"f_rest_{i}" for i in range(45))]
    expected += ["opacity", *(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]
    assert [name.decode() for name in properties] == expected
    raw = trimesh.load(tmp_path / "scene.ply").metadata["_ply_raw"]["vertex"]["data"]
    np.testing.assert_array_equal(raw["rot_0"].ravel(), splats.quats[:, 0])
    # Channel-major: all fifteen of red, then green, then blue.
    np.testing.assert_array_equal(raw["f_rest_15"].ravel(), splats.sh[:, 1, 1])
    np.testing.assert_array_equal(raw["f_rest_1"].ravel(), splats.sh[:, 2, 0])


@pytest.mark.parametrize("order", ["<", ">"])
def test_any_order_of_properties_other_types_and_elements(tmp_path, order):
    splats = make_splats(6, 1)
    io.write_ply(tmp_path / "scene.ply", splats)
    table = io.ply.read_ply_tables(tmp_path / "scene.ply")["vertex"]
    names = list(np.random.default_rng(3).permutation(table.dtype.names))
    kinds = dict.fromkeys(names, ("double", "f8")) | {"nx": ("uchar", "u1")}
    shuffled = np.zeros(6, [(name, order + kinds[name][1]) for name in names])
    for name in names:
        shuffled[name] = table[name]
    kind = "little" if order == "<" else "big"
    header = f"ply\r\nformat binary_{kind}_endian 1.0\r\ncomment by hand\r\nelement other 3\r\nproperty short a\r\n"
    header += "element vertex 6\r\n" + "".join(f"property {kinds[name][0]} {name}\r\n" for name in names)
    (tmp_path / "b.ply").write_bytes(f"{header}end_header\r\n".encode() + b"\1" * 6 + shuffled.tobytes())
    assert_equal(io.read_ply(tmp_path / "b.ply"), splats)


def test_cut_anywhere_is_named(tmp_path):
    io.write_ply(tmp_path / "scene.ply", make_splats())
    whole = (tmp_path / "scene.ply").read_bytes()
    for length in [*range(0, len(whole), 37), len(whole) - 1]:
        (tmp_path / "short.ply").write_bytes(whole[:length])
        with pytest.raises(io.InputError, match=r"short\.ply"):
            io.read_ply(tmp_path / "short.ply")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (b"element vertex 7", b"element vertex 99999999999999999", "cut short: 99999999999999999"),
        (b"element vertex 7", b"element vertex -7", "line"),
        (b"binary_little_endian", b"ascii", "ascii"),
        (b"property float opacity\n", b"", "no opacity"),
        (b"property float f_rest_3\n", b"", "f_rest"),
        (b"property float x\n", b"property list uchar int x\n", "list uchar"),
        (b"property float y\n", b"property float x\n", "x twice"),
        (b"ply\n", b"plop\n", "is not a PLY"),
    ],
)
def test_header_faults_are_named(tmp_path, old, new, message):
    io.write_ply(tmp_path / "scene.ply", make_splats())
    content = (tmp_path / "scene.ply").read_bytes().replace(old, new, 1)
    (tmp_path / "scene.ply").write_bytes(content)
    with pytest.raises(io.InputError, match=message) as caught:
        io.read_ply(tmp_path / "scene.ply")
    assert "scene.ply" in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("field", "value", "word"),
    [
        ("means", np.nan, "positions"),
        ("means", np.inf, "positions"),
        ("quats", np.nan, "rotations"),
        ("log_scales", np.inf, "scales"),
        ("logit_opacities", np.nan, "opacities"),
        ("sh", -np.inf, "colours"),
    ],
)
def test_poison_is_named(tmp_path, field, value, word):
    fields = {name: np.array(getattr(make_splats(), name)) for name in FIELDS}
    fields[field].flat[1] = value
    io.write_ply(tmp_path / "scene.ply", Splats(**{name: jnp.asarray(v) for name, v in fields.items()}))
    with pytest.raises(io.InputError, match=f"the {word} of 1 of 7"):
        io.read_ply(tmp_path / "scene.ply")


def test_limits_that_mean_something_are_kept(tmp_path):
    splats = make_splats(2)
    limits = Splats(
        splats.means, splats.quats, splats.log_scales.at[0].set(-jnp.inf), jnp.array([jnp.inf, -jnp.inf]), splats.sh
    )
    io.write_ply(tmp_path / "scene.ply", limits)
    assert_equal(io.read_ply(tmp_path / "scene.ply"), limits)


def test_a_failed_write_leaves_the_old_file(tmp_path):
    path = tmp_path / "scene.ply"
    io.write_ply(path, make_splats())
    before = path.read_bytes()
    with pytest.raises(RuntimeError), io.replacing(path) as beside:
        beside.write_bytes(b"half")
        raise RuntimeError
    assert path.read_bytes() == before and [p.name for p in tmp_path.iterdir()] == ["scene.ply"]
