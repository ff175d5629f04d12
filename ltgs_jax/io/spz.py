"""Niantic's SPZ: splats as columns of bytes, gzipped (versions 2 and 3) or as ZSTD streams (version 4)."""

import itertools
import struct
import zlib
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from ltgs_jax.geometry import rotate_sh, sh_degree, sh_rotations
from ltgs_jax.scene import Splats

from .files import InputError, read_bytes, write_bytes
from .packing import byte_of_logit, logit_of_byte, pack_quats_sign9, to_byte, unpack_quats_sign9
from .ply import checked_splats

_MAGIC = b"NGSP"
_HEADER = struct.Struct("<4sIIBBBB")
_COLOR_SCALE = 0.15  # wider than 0..1, so that higher harmonics may bring a colour back
_FRACTION_BITS = 12
_HIGHER = {0: 0, 1: 9, 2: 24, 3: 45}
# SPZ has x right, y up, z backward; PLY files have x right, y down, z forward: half a turn about x.
_HALF_TURN = np.diag([1.0, -1.0, -1.0])
_MOST_SPLATS = 50_000_000
_LARGE_BYTES = 1 << 24


def read_spz(path: str | Path) -> Splats:
    """An SPZ file of version 2, 3 or 4, SH degree 0 to 3, turned into the axes of PLY files.

    Version 4 needs the package zstandard. Raises InputError that names the file when it is not one, is cut short,
    holds more or less than its header says, or needs that package.
    """
    content = read_bytes(path)
    version, n, degree, fraction_bits, columns = _columns(content, path)
    positions, alphas, colors, scales, rotations, rest = (np.frombuffer(column, np.uint8) for column in columns)
    means = _unpack_24(positions.reshape(n, 3, 3)) / np.float32(2.0**fraction_bits)
    colors, scales = (column.reshape(n, 3).astype(np.float32) for column in (colors, scales))
    rest = rest.reshape(n, _HIGHER[degree] // 3, 3).astype(np.float32)
    xyzw = _quats_of_version(rotations.tobytes(), version, n)
    dc = (colors / 255 - np.float32(0.5)) / np.float32(_COLOR_SCALE)
    sh = np.concatenate([dc[:, None], (rest - 128) / 128], axis=1)
    turned = checked_splats(
        means=(means * np.diag(_HALF_TURN)).astype(np.float32),
        quats=np.stack([xyzw[:, 3], xyzw[:, 0], -xyzw[:, 1], -xyzw[:, 2]], axis=1),
        log_scales=scales / 16 - 10,
        logit_opacities=logit_of_byte(alphas),
        sh=sh,
        path=path,
    )
    return _with_turned_sh(turned)


def _with_turned_sh(splats: Splats) -> Splats:
    turn = sh_rotations(jnp.asarray(_HALF_TURN, splats.sh.dtype), sh_degree(splats.sh))
    sh = rotate_sh(splats.sh, turn)
    return Splats(splats.means, splats.quats, splats.log_scales, splats.logit_opacities, sh)


def _sizes(version: int, n: int, degree: int) -> list[int]:
    """Bytes of positions, opacities, colours, scales, rotations, harmonics."""
    return [9 * n, n, 3 * n, 3 * n, (3 if version < 3 else 4) * n, _HIGHER[degree] * n]


def _columns(content: bytes, path: str | Path) -> tuple[int, int, int, int, list[bytes]]:
    """Version, count, degree, fraction bits and the six columns, each of the size that the header implies."""
    if content[:4] == _MAGIC:
        version, n, degree, bits, streams = _parse_header(content, path)
        if version != 4:
            raise InputError(f"{path}: is SPZ of version {version}, which is not read outside gzip")
        sizes = _sizes(version, n, degree)
        _check_shrinkage(sum(sizes), n, content, path)
        return version, n, degree, bits, _zstd_columns(content, sizes, streams, path)
    if content[:2] != b"\x1f\x8b":
        raise InputError(f"{path}: is not an SPZ file")
    head = _inflate(content, _HEADER.size, path)
    version, n, degree, bits, _ = _parse_header(head, path)
    if version not in (2, 3):
        raise InputError(f"{path}: is SPZ of version {version}; versions 2, 3 and 4 are read")
    sizes = _sizes(version, n, degree)
    total = _HEADER.size + sum(sizes)
    _check_shrinkage(total, n, content, path)
    whole = _inflate(content, total, path)
    edges = np.cumsum([_HEADER.size, *sizes])
    return version, n, degree, bits, [whole[a:b] for a, b in itertools.pairwise(edges)]


def _check_shrinkage(total: int, n: int, content: bytes, path: str | Path) -> None:
    """No scene of that many splats was packed that small: the count is not believed, before memory is asked for it.

    Gzip shrinks at most about a thousandfold; splats that differ from one another by far less, which counts where there
    are so many that it matters.
    """
    most = 1100 if total < _LARGE_BYTES else 50
    if total > most * len(content) + 1024:
        raise InputError(f"{path}: is cut short: its header says {n} splats, its {len(content)} bytes cannot hold them")


def _parse_header(head: bytes, path: str | Path) -> tuple[int, int, int, int, int]:
    if len(head) < _HEADER.size:
        raise InputError(f"{path}: is cut short within its header")
    magic, version, n, degree, bits, _, last = _HEADER.unpack_from(head)
    if magic != _MAGIC:
        raise InputError(f"{path}: is not an SPZ file")
    if degree not in _HIGHER or bits > 23 or n > _MOST_SPLATS:
        raise InputError(f"{path}: its header says {n} splats, SH degree {degree}, {bits} fraction bits")
    return version, n, degree, bits, last


def _inflate(content: bytes, size: int, path: str | Path) -> bytes:
    """The first `size` bytes of a gzip stream; never more is unpacked than asked for."""
    try:
        inflated = zlib.decompressobj(wbits=31).decompress(content, size)
    except zlib.error as error:
        raise InputError(f"{path}: its gzip stream is damaged ({error})") from None
    if len(inflated) < size:
        raise InputError(f"{path}: is cut short: {len(inflated)} of {size} bytes")
    return inflated


def _zstd_columns(content: bytes, sizes: list[int], streams: int, path: str | Path) -> list[bytes]:
    try:
        import zstandard
    except ImportError:
        raise InputError(
            f"{path}: SPZ of version 4 needs the package zstandard: pip install 'ltgs-jax[formats]'"
        ) from None
    if len(content) < 32:
        raise InputError(f"{path}: is cut short within its header")
    (table,) = struct.unpack_from("<I", content, 16)
    wanted = [size for size in sizes if size]
    if streams < len(wanted) or table < 20 or table + 16 * streams > len(content):
        raise InputError(f"{path}: its table of {streams} streams at byte {table} does not fit the file")
    entries = struct.unpack_from(f"<{2 * streams}Q", content, table)
    at = table + 16 * streams
    columns = []
    for i, size in enumerate(wanted):
        packed, unpacked = entries[2 * i : 2 * i + 2]
        if unpacked != size or packed > len(content) - at:
            raise InputError(
                f"{path}: stream {i} holds {unpacked} bytes in {packed}, expected {size} in the file's rest"
            )
        frame = content[at : at + packed]
        try:
            # The frame's own claim is checked before the decoder allocates by it.
            if zstandard.frame_content_size(frame) not in (size, -1):
                raise InputError(f"{path}: stream {i} is not of the size that its header says")
            column = zstandard.ZstdDecompressor(max_window_size=1 << 27).decompress(frame, max_output_size=size)
        except zstandard.ZstdError as error:
            raise InputError(f"{path}: stream {i} is damaged ({error})") from None
        if len(column) != size:
            raise InputError(f"{path}: stream {i} is cut short: {len(column)} of {size} bytes")
        columns.append(column)
        at += packed
    filled = iter(columns)
    return [next(filled) if size else b"" for size in sizes]


def _unpack_24(stored: np.ndarray) -> np.ndarray:
    """Signed 24-bit integers, least byte first."""
    a, b, c = (stored[..., i].astype(np.int32) for i in range(3))
    value = a | b << 8 | c << 16
    return np.where(value >= 1 << 23, value - (1 << 24), value).astype(np.float32)


def _quats_of_version(column: bytes, version: int, n: int) -> np.ndarray:
    """Quaternions [n 4] xyzw."""
    if version >= 3:
        return unpack_quats_sign9(np.frombuffer(column, "<u4").astype(np.uint32))
    xyz = np.frombuffer(column, np.uint8).reshape(n, 3).astype(np.float32) / 127.5 - 1
    w = np.sqrt(np.clip(1 - np.sum(xyz * xyz, axis=1), 0, 1))
    return np.column_stack([xyz, w])


def write_spz(path: str | Path, splats: Splats) -> None:
    """Write SPZ of version 3 in one step: positions to 1/4096 of a unit, logarithms of scales to 1/16.

    Raises InputError when a position lies beyond ±2048 units, which the format cannot hold, or on writing.
    """
    degree = sh_degree(splats.sh)
    turned = _with_turned_sh(splats)
    fixed = np.rint(np.asarray(turned.means, np.float64) * np.diag(_HALF_TURN) * 2.0**_FRACTION_BITS)
    if splats.count and np.abs(fixed).max() >= 1 << 23:
        raise InputError(f"{path}: SPZ holds positions up to ±{1 << (23 - _FRACTION_BITS)} units, the scene is larger")
    integers = fixed.astype(np.int64) & 0xFFFFFF
    w, x, y, z = np.asarray(turned.quats).T
    sh = np.asarray(turned.sh, np.float64)
    with np.errstate(invalid="ignore"):
        scales = to_byte(np.nan_to_num((np.asarray(turned.log_scales, np.float64) + 10) * 16, neginf=0))
    columns = (
        np.stack([integers >> shift & 255 for shift in (0, 8, 16)], axis=-1).astype(np.uint8),
        byte_of_logit(np.asarray(turned.logit_opacities)),
        to_byte((sh[:, 0] * _COLOR_SCALE + 0.5) * 255),
        scales,
        pack_quats_sign9(np.stack([x, -y, -z, w], axis=1)).astype("<u4"),
        to_byte(sh[:, 1:] * 128 + 128),
    )
    content = _HEADER.pack(_MAGIC, 3, splats.count, degree, _FRACTION_BITS, 0, 0)
    content += b"".join(column.tobytes() for column in columns)
    packer = zlib.compressobj(6, zlib.DEFLATED, 31)
    write_bytes(path, packer.compress(content) + packer.flush())
