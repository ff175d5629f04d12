"""Damaged files, every reader: a one-line message that names the file, or a read; never anything else.

The quick run damages each kind of file some dozens of ways; `-m slow` more than a thousand. Photographs, whose decoders
are not this project's, are read in another process, so that a crash is a failure of one test.
"""

import json
import random
import re
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from ltgs_jax import io
from ltgs_jax.features import FromDisk, name_images
from ltgs_jax.io import load_chronology, read_capture, read_colmap, read_splats
from ltgs_jax.pipeline.outputs import read_cameras
from ltgs_jax.pipeline.store import Store
from ltgs_jax.report.page import page
from ltgs_jax.report.run import read_run
from ltgs_jax.report.shots import make_gallery
from ltgs_jax.scene import Chronology, Splats

SECONDS = 2.0
MEGABYTES = 500


def _splats(count: int = 40, degree: int = 1) -> Splats:
    rng = np.random.default_rng(0)
    shapes = ((count, 3), (count, 4), (count, 3), (count,), (count, (degree + 1) ** 2, 3))
    return Splats(*(jnp.asarray(rng.normal(size=shape), jnp.float32) for shape in shapes))


def _spz_4(path: Path) -> None:
    import zstandard

    n = 40
    columns = [
        np.random.default_rng(i).integers(0, 256, n * w).astype(np.uint8).tobytes()
        for i, w in enumerate((9, 1, 3, 3, 4))
    ]
    packed = [zstandard.compress(column) for column in columns]
    head = b"NGSP" + np.array([4, n], "<u4").tobytes() + bytes([0, 12, 0, 5]) + np.array([32, 0, 0, 0], "<u4").tobytes()
    table = np.array([(len(a), len(b)) for a, b in zip(packed, columns, strict=True)], "<u8").tobytes()
    path.write_bytes(head + table + b"".join(packed))


def _capture(folder: Path, suffix: str) -> None:
    from test_io_capture import make_capture

    make_capture(folder, (2, 1), suffix=suffix)
    (folder / "images" / "changes.txt").write_text(f"IMG_0001/000{suffix}\n")
    (folder / "images" / "test.txt").write_text(f"IMG_0000/001{suffix}\n")


def _load_everything(folder: Path) -> None:
    for photograph in read_capture(folder).photographs:
        io.load_image(photograph)
        io.load_mask(photograph)


def _binary_colmap(folder: Path) -> None:
    import zlib  # noqa: F401

    import pycolmap
    from test_io_colmap import make_model

    io.write_colmap(folder / "text", make_model())
    pycolmap.Reconstruction(str(folder / "text")).write_binary(str(folder))


def _text_colmap(folder: Path) -> None:
    from test_io_colmap import make_model

    io.write_colmap(folder, make_model())


def _transforms(folder: Path) -> None:
    frames = []
    for i in range(2):
        io.write_image(folder / f"{i}.png", np.zeros((6, 8, 3)))
        frames.append({"file_path": f"{i}.png", "time": i, "transform_matrix": np.eye(4).tolist()})
    content = {"fl_x": 8.0, "w": 8, "h": 6, "k1": 0.1, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(content))


def _mask(folder: Path) -> None:
    _capture(folder, ".png")
    io.write_labels(folder / "masks" / "IMG_0000" / "001.png", np.eye(24, 32, dtype=int))


def _folder_of_a_phone(folder: Path) -> None:
    from test_io_intake import _photograph

    _photograph(folder / "visit" / "a.jpg", orientation=6, equivalent=27)
    io.write_image(folder / "masks" / "visit.png", np.ones((24, 40, 3)))


def _bring_in(folder: Path) -> None:
    with tempfile.TemporaryDirectory() as out:
        for photograph in io.sharpest(io.find_intake(folder)[0]["visit"], 1):
            upright = io.bring_in(photograph, Path(out) / "images", max_side=16)
            io.bring_mask(photograph, upright, Path(out) / "masks")


def _run(folder: Path) -> None:
    """The small files of a finished run."""
    pose = {"wxyz": [1, 0, 0, 0], "xyz": [0, 0, 2]}
    state = {"visit": 1, "event": "moved", "visible": True, "world_from_template": pose, "confidence": 0.5}
    state |= {"inliers": 9, "residual": 0.1, "ambiguous_axis": None}
    thing = {"id": 1, "source_visit": 0, "splats": 3, "center": [0, 0, 0], "size": 1.0, "states": [state]}
    placed = {"name": "b/0.png", "status": "rejected", "inliers": 3, "reason": "too few"}
    io.write_tracks(folder / "tracks.json", visits=["a", "b"], photographs=[placed], objects=[thing])
    camera = {"K": [[8, 0, 4], [0, 8, 3], [0, 0, 1]], "width": 8, "height": 6, "cam_from_world": pose}
    camera |= {"visit": 1, "role": "update"}
    shown = {"name": "b/0.png", "visit": "b", "role": "update", "psnr": 20.5, "capture_path": "b.png"}
    row = {"key": "psnr", "visit": "b", "region": "full", "value": 20.5, "unit": "dB", "direction": "higher"}
    stage = {"stage": "fit", "seconds": 1.5, "compile_seconds": 0.5, "peak_bytes": 9, "status": "done"}
    io.write_image(folder / "b.png", np.zeros((6, 8, 3)))
    io.write_json(folder / "cameras.json", {"capture": "/nowhere", "photographs": {"b/0.png": camera}})
    io.write_json(folder / "report.json", {"photographs": [shown]})
    io.write_json(folder / "metrics.json", [row])
    bought = {"visit": "b", "what": "object 1 moved", "parameters": 7, "bytes": 28, "gain_db": 3.25}
    ledger = {**stage, "stage": "ledger", "counts": {"ledger": [bought]}}
    io.write_json(folder / "stages.json", [{**stage, "counts": {"masks": 4}}, ledger])


def _look_at(folder: Path) -> None:
    """All that a page of results is made of, and cameras for rendering and scoring."""
    run = read_run(folder)
    page(run, make_gallery(run), {})
    io.read_tracks(folder / "tracks.json")
    read_cameras(folder)


def _features(folder: Path) -> None:
    rng = np.random.default_rng(0)
    arrays = {"features": rng.normal(size=(3, 4, 5)), "stride": np.array(2), "labels": np.eye(6, 8, dtype=int)}
    keypoints = {"xy": rng.uniform(0, 6, (9, 2)), "descriptors": rng.normal(size=(9, 8))}
    np.savez_compressed(folder / "a.npz", **arrays, **keypoints)


def _read_features(folder: Path) -> None:
    image = np.zeros((6, 8, 3), np.float32)
    front_end = FromDisk(folder, name_images([("a", image)]))
    for ask in (front_end.describe, front_end.propose, front_end.keypoints):
        try:
            ask(image)
        except ValueError as error:  # the room's own word for a wrong file: it does not know `io`
            raise io.InputError(str(error)) from error


def _stage(folder: Path) -> None:
    Store(folder, _Silent()).run("fit", "key", lambda: ({"a": np.arange(5.0)}, {"counts": {"splats": 5}}))


class _Silent:
    def stage(self, name): ...

    def note(self, text): ...


def _split(folder: Path) -> None:
    for i in range(2):
        io.write_image(folder / "images" / f"{i}.png", np.zeros((6, 8, 3)))
    (folder / "sparse").mkdir()
    (folder / "sparse" / "split.txt").write_text("0.png 0\n1.png 1\n")


KINDS = {
    "ply": ("a.ply", lambda f: io.write_ply(f / "a.ply", _splats()), lambda f: read_splats(f / "a.ply")),
    "compressed-ply": (
        "a.ply",
        lambda f: io.write_splats(f / "a.ply", _splats(), form="compressed-ply"),
        lambda f: read_splats(f / "a.ply"),
    ),
    "spz-3": ("a.spz", lambda f: io.write_splats(f / "a.spz", _splats()), lambda f: read_splats(f / "a.spz")),
    "spz-4": ("a.spz", lambda f: _spz_4(f / "a.spz"), lambda f: read_splats(f / "a.spz")),
    "splat": ("a.splat", lambda f: io.write_splats(f / "a.splat", _splats()), lambda f: read_splats(f / "a.splat")),
    "cameras.bin": ("cameras.bin", _binary_colmap, read_colmap),
    "images.bin": ("images.bin", _binary_colmap, read_colmap),
    "points3D.bin": ("points3D.bin", _binary_colmap, read_colmap),
    "cameras.txt": ("cameras.txt", _text_colmap, read_colmap),
    "images.txt": ("images.txt", _text_colmap, read_colmap),
    "points3D.txt": ("points3D.txt", _text_colmap, read_colmap),
    "transforms.json": ("transforms.json", _transforms, _load_everything),
    "split.txt": ("sparse/split.txt", _split, read_capture),
    "changes.txt": ("images/changes.txt", lambda f: _capture(f, ".png"), read_capture),
    "test.txt": ("images/test.txt", lambda f: _capture(f, ".png"), read_capture),
    "chronology": (
        "chronology.safetensors",
        lambda f: io.save_chronology(f, Chronology.of_initial(_splats(), ("a", "b"))),
        load_chronology,
    ),
    "mask": ("masks/IMG_0000/001.png", _mask, _load_everything),
    "photograph of a phone": ("visit/a.jpg", _folder_of_a_phone, _bring_in),
    "mask of a phone": ("masks/visit.png", _folder_of_a_phone, _bring_in),
    **{
        f"{name}.json": (f"{name}.json", _run, _look_at)
        for name in ("tracks", "cameras", "report", "metrics", "stages")
    },
    "features.npz": ("a.npz", _features, _read_features),
    "stage": ("stages/fit.safetensors", _stage, _stage),
    **{
        f"photograph{suffix}": (f"images/IMG_0000/001{suffix}", lambda f, s=suffix: _capture(f, s), _load_everything)
        for suffix in (".png", ".jpg", ".tif", ".webp", ".bmp", ".ppm")
    },
}
"""The file that is damaged, what makes it and the rest, what reads it."""


def damaged(whole: bytes, rng: random.Random) -> bytes:
    """The file cut, bent in some bits, with a number blown up, a part doubled, lost or zeroed."""
    content = bytearray(whole)
    way = rng.randrange(6)
    if way == 0:
        return bytes(content[: rng.randrange(len(content))])
    if way == 1:
        for _ in range(rng.choice((1, 1, 4, 32))):
            content[rng.randrange(len(content))] ^= 1 << rng.randrange(8)
    elif way == 2:
        numbers = [m.span() for m in re.finditer(rb"\d+", bytes(content[:4000]))]
        if not numbers:
            return bytes(content[: len(content) // 2])
        a, b = rng.choice(numbers)
        content[a:b] = rng.choice((b"0", b"-1", b"99999999999999999999", b"1e400", b"nan", b"4294967295", b"../../x"))
    elif way == 3:
        # The counts of binary headers lie near the beginning.
        at = rng.randrange(max(1, min(len(content) - 8, 200)))
        content[at : at + 8] = rng.choice(
            (b"\xff" * 8, b"\0" * 8, b"\xff\xff\xff\x7f" + b"\0" * 4, b"\0" * 7 + b"\x7f")
        )
    elif way == 4:
        a = rng.randrange(len(content))
        content[a : a + rng.randrange(1, 200)] = b""
    else:
        a = rng.randrange(len(content))
        content[a:a] = content[: rng.randrange(1, 200)]
    return bytes(content)


def run(kind: str, folder: Path, rounds: int) -> None:
    """Damage, read, judge; runs in its own process."""
    name, make, read = KINDS[kind]
    make(folder)
    read(folder)
    path = folder / name
    whole = path.read_bytes()
    before = sorted(folder.parent.rglob("*"))
    start_memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for seed in range(rounds):
        path.write_bytes(damaged(whole, random.Random(seed)))
        start = time.process_time()
        try:
            read(folder)
        except io.InputError as error:
            message = str(error)
            assert "\n" not in message and str(folder) in message and len(message) < 1000, (seed, message)
        except Exception as error:
            raise AssertionError(f"{kind}, seed {seed}: {error!r}") from error
        assert time.process_time() - start < SECONDS, f"{kind}, seed {seed}: too slow"
    grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - start_memory) / 1024
    assert grown < MEGABYTES, f"{kind}: {grown:.0f} MB more"
    path.write_bytes(whole)
    assert sorted(folder.parent.rglob("*")) == before


def _in_a_process(kinds: list[str], folder: Path, rounds: int) -> None:
    code = "import pathlib, test_io_fuzz as t\n"
    for kind in kinds:
        inside = folder / kind / "inside"
        inside.mkdir(parents=True)
        code += f"t.run({kind!r}, pathlib.Path({str(inside)!r}), {rounds})\n"
    paths = [str(Path(__file__).parent), str(Path(__file__).parents[1])]
    script = f"import sys; sys.path[:0] = {paths!r}\n{code}"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, f"exit {done.returncode}: {done.stderr[-2000:]}"


@pytest.mark.parametrize("kind", [kind for kind in KINDS if not kind.startswith("photograph")])
def test_damaged_files(tmp_path, kind):
    if kind == "spz-4":
        pytest.importorskip("zstandard")
    (tmp_path / "inside").mkdir()
    run(kind, tmp_path / "inside", 60)


def test_damaged_photographs(tmp_path):
    _in_a_process([kind for kind in KINDS if kind.startswith("photograph")], tmp_path, 20)


def test_features_that_unpack_beyond_measure_are_refused(tmp_path, monkeypatch):
    _features(tmp_path)
    monkeypatch.setattr("ltgs_jax.features.disk._MOST_BYTES", 1000)
    with pytest.raises(io.InputError, match=r"a\.npz: .*unpacked it has more than"):
        _read_features(tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_damaged_files_many_ways(tmp_path, kind):
    if kind == "spz-4":
        pytest.importorskip("zstandard")
    _in_a_process([kind], tmp_path, 1000)
