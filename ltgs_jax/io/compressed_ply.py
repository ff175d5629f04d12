"""SuperSplat's compressed PLY: chunks of 256 splats, each splat in 16 bytes within its chunk's bounds."""

import math
from pathlib import Path

import numpy as np

from ltgs_jax.geometry import sh_degree
from ltgs_jax.scene import Splats

from .files import InputError, write_bytes
from .packing import (
    byte_of_logit,
    color_of_sh,
    logit_of_byte,
    pack_quats_10,
    sh_of_color,
    to_byte,
    unpack_quats_10,
)
from .ply import checked_splats, read_ply_tables

CHUNK = 256
_BOUNDS = ("x", "y", "z", "scale_x", "scale_y", "scale_z", "r", "g", "b")
_PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
_SH_RANGE = 8.0  # higher coefficients are stored over −4…4
_SMALLEST_LOG_SCALE, _LARGEST_LOG_SCALE = -20.0, 20.0  # what the format's own tools clamp to


def is_compressed_ply(tables: dict[str, np.ndarray]) -> bool:
    """Whether the tables of a PLY are SuperSplat's."""
    return "chunk" in tables and "packed_position" in (tables.get("vertex", np.zeros(0)).dtype.names or ())


def read_compressed_ply(path: str | Path) -> Splats:
    """A compressed PLY, with the colours' bounds and harmonics where it has them.

    Raises InputError that names the file when it is not one, is cut short, or its chunks do not fit its splats.
    """
    return splats_of_chunks(read_ply_tables(path), path)


def splats_of_chunks(tables: dict[str, np.ndarray], path: str | Path) -> Splats:
    """Splats of the tables of a compressed PLY. Raises InputError that names the file."""
    vertices, chunks = tables.get("vertex"), tables.get("chunk")
    if vertices is None or chunks is None:
        raise InputError(f"{path}: is not a compressed PLY: it has no {'vertices' if vertices is None else 'chunks'}")
    n = len(vertices)
    names = set(chunks.dtype.names or ())
    wanted = [f"{end}_{name}" for name in _BOUNDS[:6] for end in ("min", "max")]
    missing = [name for name in wanted if name not in names]
    missing += [name for name in _PACKED if name not in (vertices.dtype.names or ())]
    if missing:
        raise InputError(f"{path}: is not a compressed PLY: it has no {missing[0]}")
    if not n <= len(chunks) * CHUNK < n + CHUNK:
        raise InputError(f"{path}: has {len(chunks)} chunks for {n} splats, expected {math.ceil(n / CHUNK)}")
    home = np.arange(n) // CHUNK

    def within(fields: np.ndarray, axes: tuple[str, ...]) -> np.ndarray:
        low, high = (np.stack([chunks[f"{end}_{axis}"] for axis in axes], axis=1)[home] for end in ("min", "max"))
        return (low + fields * (high - low)).astype(np.float32)

    color = vertices["packed_color"].astype(np.uint32)
    rgb = np.stack([(color >> shift) & 255 for shift in (24, 16, 8)], axis=1).astype(np.float32) / 255
    # The format's first version has no bounds of colours.
    if all(f"{end}_{axis}" in names for axis in _BOUNDS[6:] for end in ("min", "max")):
        rgb = within(rgb, _BOUNDS[6:])
    sh = np.concatenate([sh_of_color(rgb)[:, None], _higher_sh(tables.get("sh"), n, path)], axis=1)
    return checked_splats(
        means=within(_unpack_11_10_11(vertices["packed_position"]), _BOUNDS[:3]),
        quats=unpack_quats_10(vertices["packed_rotation"].astype(np.uint32)),
        log_scales=within(_unpack_11_10_11(vertices["packed_scale"]), _BOUNDS[3:6]),
        logit_opacities=logit_of_byte(color & 255),
        sh=sh,
        path=path,
    )


def _unpack_11_10_11(packed: np.ndarray) -> np.ndarray:
    packed = packed.astype(np.uint32)
    return np.stack([(packed >> 21) / 2047, ((packed >> 11) & 1023) / 1023, (packed & 2047) / 2047], axis=1)


def _pack_11_10_11(fields: np.ndarray) -> np.ndarray:
    x, y, z = np.clip(np.rint(fields * [2047, 1023, 2047]), 0, [2047, 1023, 2047]).astype(np.uint32).T
    return x << 21 | y << 11 | z


def _higher_sh(table: np.ndarray | None, n: int, path: str | Path) -> np.ndarray:
    """Coefficients above degree 0 [n k−1 3], from bytes, channel by channel."""
    if table is None:
        return np.zeros((n, 0, 3), np.float32)
    count = len(table.dtype.names or ())
    if count not in (9, 24, 45) or len(table) != n:
        raise InputError(f"{path}: has {count} harmonics for {len(table)} of {n} splats; expected 9, 24 or 45 for all")
    try:
        stored = np.stack([table[f"f_rest_{i}"] for i in range(count)], axis=1).astype(np.float32)
    except ValueError:
        raise InputError(f"{path}: its harmonics are not named f_rest_0 to f_rest_{count - 1}") from None
    # The two ends stand for the ends of the range, the others for the middles of their steps.
    share = np.select([stored == 0, stored == 255], [0, 1], (stored + 0.5) / 256)
    return ((share - 0.5) * _SH_RANGE).astype(np.float32).reshape(n, 3, -1).transpose(0, 2, 1)


def write_compressed_ply(path: str | Path, splats: Splats) -> None:
    """Write a compressed PLY in one step: 16 bytes per splat, and one per coefficient above degree 0.

    The splats are put in Morton order, which keeps chunks small and so their steps. Positions keep 1/2047 of their
    chunk's extent, rotations about 0.1°, opacities and colours 8 bits. Raises InputError when it cannot be written.
    """
    sh_degree(splats.sh)
    n = splats.count
    order = _morton_order(np.asarray(splats.means, np.float64))
    means = np.asarray(splats.means, np.float64)[order]
    log_scales = np.clip(np.asarray(splats.log_scales, np.float64)[order], _SMALLEST_LOG_SCALE, _LARGEST_LOG_SCALE)
    sh = np.asarray(splats.sh, np.float64)[order]
    colors = color_of_sh(sh[:, 0])
    home = np.arange(n) // CHUNK
    starts = np.arange(0, n, CHUNK)
    bounds, shares = [], []
    for values in (means, log_scales, colors):
        low, high = np.zeros((0, 3)), np.zeros((0, 3))
        if n:
            low, high = (f.reduceat(values, starts).astype(np.float32) for f in (np.minimum, np.maximum))
        extent = (high - low)[home]
        shares.append((values - low[home]) / np.where(extent > 0, extent, 1))
        bounds += [low, high]
    opacity = byte_of_logit(np.asarray(splats.logit_opacities)[order]).astype(np.uint32)
    r, g, b = to_byte(shares[2] * 255).astype(np.uint32).T
    packed = np.stack(
        [
            _pack_11_10_11(shares[0]),
            pack_quats_10(np.asarray(splats.quats)[order]),
            _pack_11_10_11(shares[1]),
            r << 24 | g << 16 | b << 8 | opacity,
        ],
        axis=1,
    )
    rest = sh[:, 1:].transpose(0, 2, 1).reshape(n, 3 * (sh.shape[1] - 1))
    harmonics = to_byte(np.floor((rest / _SH_RANGE + 0.5) * 256)) if rest.shape[1] else None
    names = [
        f"{end}_{axis}"
        for group in (_BOUNDS[:3], _BOUNDS[3:6], _BOUNDS[6:])
        for end in ("min", "max")
        for axis in group
    ]
    header = f"ply\nformat binary_little_endian 1.0\nelement chunk {len(starts)}\n"
    header += "".join(f"property float {name}\n" for name in names)
    header += f"element vertex {n}\n" + "".join(f"property uint {name}\n" for name in _PACKED)
    if harmonics is not None:
        header += f"element sh {n}\n" + "".join(f"property uchar f_rest_{i}\n" for i in range(harmonics.shape[1]))
    content = np.concatenate(bounds, axis=1).astype("<f4").tobytes() + packed.astype("<u4").tobytes()
    content += b"" if harmonics is None else harmonics.tobytes()
    write_bytes(path, f"{header}end_header\n".encode() + content)


def _morton_order(means: np.ndarray) -> np.ndarray:
    """Indices along a space-filling curve: the bits of the three coordinates, interleaved."""
    if len(means) == 0:
        return np.zeros(0, np.int64)
    low, high = means.min(axis=0), means.max(axis=0)
    cells = ((means - low) / np.where(high > low, high - low, 1) * 1023).astype(np.uint64)
    code = np.zeros(len(means), np.uint64)
    for bit in range(10):
        for axis in range(3):
            code |= ((cells[:, axis] >> np.uint64(bit)) & np.uint64(1)) << np.uint64(3 * bit + axis)
    return np.argsort(code, kind="stable")
