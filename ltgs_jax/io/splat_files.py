"""Splat files of any kind by what is in them, and the 32 bytes per splat of `.splat`."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from ltgs_jax.scene import Splats

from .compressed_ply import is_compressed_ply, splats_of_chunks, write_compressed_ply
from .files import InputError, read_bytes, write_bytes
from .packing import byte_of_logit, color_of_sh, logit_of_byte, sh_of_color, to_byte
from .ply import checked_splats, read_ply_tables, splats_of_vertices, write_ply
from .spz import read_spz, write_spz

_RECORD = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("quat", "u1", 4)])


def read_splats(path: str | Path) -> Splats:
    """A splat scene of any format that is read: Inria's PLY, SuperSplat's compressed PLY, SPZ, `.splat`.

    PLY and SPZ are known by their first bytes; `.splat`, which has none, by its suffix.
    Raises InputError that names the file.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: no such file" if not path.exists() else f"{path}: expected a file")
    with path.open("rb") as file:
        magic = file.read(4)
    if magic.startswith(b"ply"):
        tables = read_ply_tables(path)
        if is_compressed_ply(tables):
            return splats_of_chunks(tables, path)
        if "vertex" not in tables:
            raise InputError(f"{path}: has no vertices")
        return splats_of_vertices(tables["vertex"], path)
    if magic == b"NGSP" or magic.startswith(b"\x1f\x8b"):
        return read_spz(path)
    if path.suffix.lower() == ".splat":
        return read_splat(path)
    raise InputError(f"{path}: is no splat file that is read (PLY, compressed PLY, SPZ, .splat)")


def write_splats(path: str | Path, splats: Splats, *, form: str | None = None) -> None:
    """Write splats as `form` (`ply`, `compressed-ply`, `spz`, `splat`), or by the suffix where none is given.

    Raises InputError when neither names a format or the file cannot be written.
    """
    if form is None:
        name = Path(path).name.lower()
        fitting = [key for key, (suffix, _) in WRITERS.items() if name.endswith(suffix)]
        form = fitting[-1] if fitting else None
    if form not in WRITERS:
        raise InputError(f"{path}: no splat format of that name; expected one of {', '.join(WRITERS)}")
    WRITERS[form][1](path, splats)


def read_splat(path: str | Path) -> Splats:
    """A `.splat` file: float positions and scales, colours, opacities and rotations of 8 bits, no harmonics.

    Raises InputError that names the file.
    """
    content = read_bytes(path)
    if len(content) % _RECORD.itemsize:
        raise InputError(f"{path}: is cut short or not a .splat file: {len(content)} bytes are no multiple of 32")
    table = np.frombuffer(content, _RECORD)
    if np.any(table["scale"] < 0):
        raise InputError(f"{path}: is not a .splat file: it has negative scales")
    with np.errstate(divide="ignore", invalid="ignore"):
        log_scales = np.log(table["scale"])
    return checked_splats(
        means=table["mean"].copy(),
        quats=(table["quat"].astype(np.float32) - 128) / 128,
        log_scales=log_scales,
        logit_opacities=logit_of_byte(table["rgba"][:, 3]),
        sh=sh_of_color(table["rgba"][:, :3].astype(np.float32) / 255)[:, None],
        path=path,
    )


def write_splat(path: str | Path, splats: Splats) -> None:
    """Write `.splat` in one step; harmonics above degree 0 are left out, as the format has none. Raises InputError."""
    quats = np.asarray(splats.quats, np.float64)
    norms = np.linalg.norm(quats, axis=1, keepdims=True)
    unit = np.where(norms > 0, quats / np.where(norms > 0, norms, 1), [1, 0, 0, 0])
    table = np.empty(splats.count, _RECORD)
    table["mean"] = np.asarray(splats.means)
    table["scale"] = np.exp(np.asarray(splats.log_scales, np.float64))
    table["rgba"][:, :3] = to_byte(color_of_sh(np.asarray(splats.sh[:, 0])) * 255)
    table["rgba"][:, 3] = byte_of_logit(np.asarray(splats.logit_opacities))
    table["quat"] = to_byte(unit * 128 + 128)
    write_bytes(path, table.tobytes())


WRITERS: dict[str, tuple[str, Callable[[str | Path, Splats], None]]] = {
    "ply": (".ply", write_ply),
    "compressed-ply": (".compressed.ply", write_compressed_ply),
    "spz": (".spz", write_spz),
    "splat": (".splat", write_splat),
}
"""Formats that are written: name, suffix, writer."""
SPLAT_FORMATS = tuple(WRITERS)
