"""Splat scenes as PLY in the layout of Inria's 3DGS: stored parameters, before activation."""

import dataclasses
import math
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from ltgs_jax.geometry import sh_degree
from ltgs_jax.scene import Splats

from .files import InputError, read_bytes, write_bytes

_TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}
_LONGEST_HEADER = 1 << 16


@dataclasses.dataclass(frozen=True)
class PlyElement:
    """One element of a header: its name, count, and properties as a NumPy record."""

    name: str
    count: int
    dtype: np.dtype


def read_ply_tables(path: str | Path) -> dict[str, np.ndarray]:
    """The elements of a binary PLY as record arrays, whatever they hold.

    Raises InputError that names the file: no PLY, ASCII, list properties, or fewer bytes than the header claims.
    """
    content = read_bytes(path)
    elements, at = _parse_header(content, path)
    tables = {}
    for element in elements:
        size = element.count * element.dtype.itemsize
        # Before anything is allocated: a header may claim any count.
        if size > len(content) - at:
            whole = (len(content) - at) // element.dtype.itemsize
            raise InputError(f"{path}: is cut short: {element.count} of {element.name} in its header, {whole} in it")
        tables[element.name] = np.frombuffer(content, element.dtype, element.count, at)
        at += size
    return tables


def _parse_header(content: bytes, path: str | Path) -> tuple[list[PlyElement], int]:
    if not content.startswith((b"ply\n", b"ply\r\n")):
        raise InputError(f"{path}: is not a PLY file")
    end = content.find(b"\nend_header", 0, _LONGEST_HEADER)
    newline = content.find(b"\n", end + 1, end + 16)
    if end < 0 or newline < 0:
        raise InputError(f"{path}: is cut short within its header")
    order = None
    elements: list[tuple[str, int, list[tuple[str, str]]]] = []
    for line in content[:end].decode("ascii", "replace").splitlines()[1:]:
        tokens = line.split()
        if not tokens or tokens[0] in ("comment", "obj_info"):
            continue
        if tokens[0] == "format" and len(tokens) == 3:
            order = {"binary_little_endian": "<", "binary_big_endian": ">"}.get(tokens[1])
            if order is None:
                raise InputError(f"{path}: is a PLY of format {tokens[1]}; only binary ones are read")
        elif tokens[0] == "element" and len(tokens) == 3 and tokens[2].isdecimal() and len(tokens[2]) < 19:
            elements.append((tokens[1], int(tokens[2]), []))
        elif tokens[0] == "property" and len(tokens) == 3 and tokens[1] in _TYPES and elements:
            if tokens[2] in dict(elements[-1][2]):
                raise InputError(f"{path}: its header has {tokens[2]} twice")
            elements[-1][2].append((tokens[2], _TYPES[tokens[1]]))
        else:
            raise InputError(f"{path}: its header has the line {line[:60]!r}, which a splat scene does not have")
    if order is None:
        raise InputError(f"{path}: its header names no format")
    records = [
        PlyElement(name, count, np.dtype([(prop, order + kind) for prop, kind in properties]))
        for name, count, properties in elements
        if properties
    ]
    return records, newline + 1


def read_ply(path: str | Path) -> Splats:
    """A splat scene in Inria's layout, SH degree 0 to 3, properties in any order, frame and values kept: float32.

    Raises InputError that names the file: not such a PLY, cut short, or holding values that are not numbers.
    """
    vertices = read_ply_tables(path).get("vertex")
    if vertices is None:
        raise InputError(f"{path}: has no vertices")
    return splats_of_vertices(vertices, path)


def splats_of_vertices(vertices: np.ndarray, path: str | Path) -> Splats:
    """Splats of a record array with Inria's properties. Raises InputError that names the file."""
    names = set(vertices.dtype.names or ())
    rest = [name for name in names if name.startswith("f_rest_")]
    needed = [
        *("x", "y", "z"),
        *(f"f_dc_{i}" for i in range(3)),
        *(f"f_rest_{i}" for i in range(len(rest))),
        "opacity",
        *(f"scale_{i}" for i in range(3)),
        *(f"rot_{i}" for i in range(4)),
    ]
    missing = [name for name in needed if name not in names]
    if missing:
        raise InputError(f"{path}: is not a splat scene in Inria's layout: it has no {', '.join(missing[:4])}")
    k = len(rest) // 3 + 1
    if len(rest) % 3 or math.isqrt(k) ** 2 != k or k > 16:
        raise InputError(f"{path}: has {len(rest)} f_rest properties; expected 0, 9, 24 or 45 (SH degree 0 to 3)")

    def columns(*wanted: str) -> np.ndarray:
        table = np.empty((len(vertices), len(wanted)), np.float32)
        with np.errstate(over="ignore", invalid="ignore"):
            for i, name in enumerate(wanted):
                table[:, i] = vertices[name]
        return table

    # f_rest is channel-major in the file, basis-major here.
    higher = columns(*(f"f_rest_{i}" for i in range(len(rest)))).reshape(len(vertices), 3, k - 1).transpose(0, 2, 1)
    dc = columns("f_dc_0", "f_dc_1", "f_dc_2")[:, None, :]
    return checked_splats(
        means=columns("x", "y", "z"),
        quats=columns("rot_0", "rot_1", "rot_2", "rot_3"),
        log_scales=columns("scale_0", "scale_1", "scale_2"),
        logit_opacities=columns("opacity")[:, 0],
        sh=np.concatenate([dc, higher], axis=1),
        path=path,
    )


def checked_splats(*, means, quats, log_scales, logit_opacities, sh, path: str | Path) -> Splats:
    """Splats of float32 arrays from a file. Raises InputError where a value cannot be rendered.

    An opacity may be ±inf (logit of 0 or 1) and a scale 0 (log −inf); NaN may not be anywhere.
    """
    poisoned = (
        ("positions", ~np.isfinite(means)),
        ("rotations", ~np.isfinite(quats)),
        ("scales", np.isnan(log_scales) | (log_scales == np.inf)),
        ("opacities", np.isnan(logit_opacities)[:, None]),
        ("colours", ~np.isfinite(sh).reshape(len(sh), sh.shape[1] * 3)),
    )
    for what, bad in poisoned:
        count = int(bad.any(axis=1).sum())
        if count:
            raise InputError(f"{path}: the {what} of {count} of {len(means)} splats are not finite numbers")
    return Splats(
        means=jnp.asarray(means),
        quats=jnp.asarray(quats),
        log_scales=jnp.asarray(log_scales),
        logit_opacities=jnp.asarray(logit_opacities),
        sh=jnp.asarray(sh),
    )


def write_ply(path: str | Path, splats: Splats) -> None:
    """Write splats as float32 in Inria's layout and order, in one step; `read_ply` gives the same back.

    Raises InputError when the file cannot be written.
    """
    sh_degree(splats.sh)
    sh = np.asarray(splats.sh, np.float32)
    rest = (sh.shape[1] - 1) * 3
    blocks = (
        (("x", "y", "z"), splats.means),
        (("nx", "ny", "nz"), np.zeros((splats.count, 3))),
        (tuple(f"f_dc_{i}" for i in range(3)), sh[:, 0]),
        (tuple(f"f_rest_{i}" for i in range(rest)), sh[:, 1:].transpose(0, 2, 1).reshape(splats.count, rest)),
        (("opacity",), splats.logit_opacities[:, None]),
        (tuple(f"scale_{i}" for i in range(3)), splats.log_scales),
        (tuple(f"rot_{i}" for i in range(4)), splats.quats),
    )
    names = [name for block, _ in blocks for name in block]
    table = np.concatenate([np.asarray(values, "<f4") for _, values in blocks], axis=1)
    properties = "".join(f"property float {name}\n" for name in names)
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {splats.count}\n{properties}end_header\n"
    write_bytes(path, header.encode() + table.tobytes())
