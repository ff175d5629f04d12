"""Files made to hurt: bombs, counts beyond all memory, names that lead out of the folder."""

import gzip
import json
import resource
import struct
import subprocess
import sys
import zlib
from pathlib import Path

import numpy as np
import pytest
from test_io_fuzz import MEGABYTES, SECONDS

from ltgs_jax import io


def _png(width: int, height: int) -> bytes:
    """A true PNG of zeros, grey, a row at a time."""

    def chunk(kind: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    packer, packed = zlib.compressobj(9), []
    for _ in range(height):
        packed.append(packer.compress(bytes(width + 1)))
    body = b"".join(packed) + packer.flush()
    head = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", body) + chunk(b"IEND", b"")


def _spz_bomb() -> bytes:
    """A whole SPZ of 20 million equal splats in 400 kB."""
    n = 20_000_000
    content = struct.pack("<4sIIBBBB", b"NGSP", 3, n, 0, 12, 0, 0)
    packer = zlib.compressobj(9, wbits=31)
    parts = [packer.compress(content)]
    for _ in range(20):
        parts.append(packer.compress(bytes(n)))
    return b"".join(parts) + packer.flush()


def _ply(*lines: str) -> bytes:
    return "\n".join(("ply", "format binary_little_endian 1.0", *lines, "end_header", "")).encode()


def _safetensors(header: dict | bytes, length: int | None = None) -> bytes:
    content = header if isinstance(header, bytes) else json.dumps(header).encode()
    return struct.pack("<Q", len(content) if length is None else length) + content


_DESCRIBED = {
    "version": 1, "visits": ["a"], "photographs": [], "templates": [], "background_splats": 10**15
}  # fmt: skip
FILES = {
    "many-vertices.ply": lambda: _ply("element vertex 999999999999", "property float x"),
    "many-elements.ply": lambda: _ply(*[f"element e{i} 1000000000\nproperty uchar x" for i in range(200)]),
    "many-properties.ply": lambda: _ply("element vertex 1", *[f"property double p{i}" for i in range(200_000)]),
    "long-header.ply": lambda: b"ply\nformat ascii 1.0\n" + b"comment x\n" * 3_000_000,
    "lists.ply": lambda: _ply("element vertex 1000000000", "property list uint float x"),
    "bomb.spz": _spz_bomb,
    "count.spz": lambda: gzip.compress(struct.pack("<4sIIBBBB", b"NGSP", 3, 49_000_000, 3, 12, 0, 0) + bytes(999)),
    "shapes/chronology.safetensors": lambda: _safetensors(
        {
            "__metadata__": {"chronology": json.dumps(_DESCRIBED)},
            "background.means": {"dtype": "F32", "shape": [10**15, 3], "data_offsets": [0, 12 * 10**15]},
        }
    ),
    "length/chronology.safetensors": lambda: _safetensors(b"{}", 1 << 62),
    "deep/chronology.safetensors": lambda: _safetensors(b"[" * 5_000_000),
    "escape/chronology.safetensors": lambda: _safetensors(
        {"__metadata__": {"chronology": json.dumps({**_DESCRIBED, "visits": ["../../out"], "background_splats": 0})}}
    ),
    "tracks.json": lambda: b'{"version": 1, "visits": ' + b"[" * 2_000_000,
    "wrong/tracks.json": lambda: json.dumps(
        {"version": 1, "visits": ["a"], "photographs": [], "objects": [{"id": 10**400}]}
    ).encode(),
    "colmap/cameras.bin": lambda: struct.pack("<Q", 1 << 62),
    "size/cameras.txt": lambda: b"1 PINHOLE 999999999 999999999 1 1 1 1\n",
    "image/a.png": lambda: _png(16_000, 16_000),
    "wide/a.png": lambda: _png(1 << 20, 200),
}


def _read(path: Path) -> None:
    if path.name == "chronology.safetensors":
        io.load_chronology(path.parent)
    elif path.name == "tracks.json":
        io.read_tracks(path)
    elif path.name.startswith("cameras"):
        io.read_colmap(path.parent)
    elif path.suffix == ".png":
        io.read_pixels(path)
    else:
        io.read_splats(path)


def judge(path: str) -> None:
    """Read one file in this process: it must end in a message, soon and with little memory."""
    start, memory = resource.getrusage(resource.RUSAGE_SELF), 1024
    try:
        _read(Path(path))
    except io.InputError as error:
        message = str(error)
        assert "\n" not in message and path.rsplit("/", 1)[0] in message and len(message) < 1000, message
    else:
        raise AssertionError("it was read")
    end = resource.getrusage(resource.RUSAGE_SELF)
    assert end.ru_utime - start.ru_utime < SECONDS, f"{end.ru_utime - start.ru_utime:.1f} s"
    grown = (end.ru_maxrss - start.ru_maxrss) / memory
    assert grown < MEGABYTES, f"{grown:.0f} MB"


def test_hostile_files_end_in_a_message_soon_and_with_little_memory(tmp_path):
    """One process for all: a crash, a hang or an allocation beyond measure is seen from outside."""
    code = ["import test_io_hostile as t"]
    for name, make in FILES.items():
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(make())
        code.append(f"print({name!r}, flush=True); t.judge({str(path)!r})")
    for name in ("images", "points3D"):
        (tmp_path / "colmap" / f"{name}.bin").write_bytes(struct.pack("<Q", 0))
        (tmp_path / "size" / f"{name}.txt").write_text("")
    paths = [str(Path(__file__).parent), str(Path(__file__).parents[1])]
    script = f"import sys; sys.path[:0] = {paths!r}\n" + "\n".join(code)
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, f"{done.stdout.splitlines()[-1:]}: {done.stderr[-1500:]}"


@pytest.mark.parametrize("name", ["../../outside.png", "/etc/outside.png", "..\\..\\outside.png"])
def test_names_that_lead_out_of_the_folder_are_refused(tmp_path, name):
    (tmp_path / "outside.png").write_bytes(b"x")
    folder = tmp_path / "a" / "b"
    frames = [{"file_path": name, "time": 0, "transform_matrix": np.eye(4).tolist()}]
    io.write_json(folder / "transforms.json", {"fl_x": 8.0, "w": 8, "h": 6, "frames": frames})
    with pytest.raises(io.InputError, match="is not a name inside the folder"):
        io.read_capture(folder)
