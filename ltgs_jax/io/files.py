"""Errors about a user's files, and writing that never leaves a half-written file."""

import contextlib
import json
import math
import os
import re
import tempfile
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import Any


class InputError(ValueError):
    """A user's file, folder or option is wrong; the message is one line that names it."""


@contextlib.contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """A path beside `path` to write to, renamed onto it when the block ends well and removed when it does not.

    The folder is made when it is missing. The temporary name keeps the suffix, which some writers go by.
    Raises InputError when the folder or the file cannot be written.
    """
    path = Path(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(prefix=f".{path.stem}.", suffix=path.suffix, dir=path.parent)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror or error})") from None
    os.close(handle)
    beside = Path(name)
    try:
        yield beside
        # mkstemp makes the file readable by its owner alone; a result is as readable as the umask allows.
        umask = os.umask(0)
        os.umask(umask)
        beside.chmod(0o666 & ~umask)
        beside.replace(path)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror or error})") from None
    finally:
        beside.unlink(missing_ok=True)


def write_bytes(path: str | Path, content: bytes) -> None:
    """Write `content` to `path` in one step: beside it first, then renamed. Raises InputError."""
    with replacing(path) as beside, beside.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())


def write_json(path: str | Path, value: Any) -> None:
    """Write JSON in one step; NaN and infinities, which JSON does not have, become null. Raises InputError."""
    text = json.dumps(plain_json(value), indent=1, allow_nan=False)
    write_bytes(path, (text + "\n").encode())


def plain_json(value: Any) -> Any:
    """The value with non-finite floats as None, NumPy and JAX scalars and arrays as Python's, paths as text."""
    if isinstance(value, dict):
        return {str(key): plain_json(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain_json(item) for item in value]
    if isinstance(value, Path):
        return str(value)
    if hasattr(value, "tolist"):
        return plain_json(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def read_bytes(path: str | Path) -> bytes:
    """The content of a file. Raises InputError that names it."""
    path = Path(path)
    if not path.exists():
        raise InputError(f"{path}: no such file")
    if not path.is_file():
        raise InputError(f"{path}: expected a file")
    try:
        return path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from None


def read_text(path: str | Path) -> str:
    """The content of a UTF-8 text file, with or without a byte order mark. Raises InputError that names it."""
    try:
        return read_bytes(path).decode("utf-8-sig")
    except UnicodeDecodeError:
        raise InputError(f"{path}: is not UTF-8 text") from None


def read_json(path: str | Path, expected: type = dict) -> Any:
    """A JSON file whose outermost value is of type `expected`; NaN and infinities are not JSON, and refused.

    Raises InputError that names it.
    """
    text = read_text(path)
    try:
        value = json.loads(text, parse_float=_finite, parse_constant=_finite)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: is not JSON ({error})") from None
    if not isinstance(value, expected):
        raise InputError(f"{path}: expected a JSON {expected.__name__}, got {type(value).__name__}")
    return value


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{text:.20} is no number")
    return value


def safe_name(name: str, *, source: str | Path) -> str:
    """A relative name that stays inside its folder. Raises InputError naming `source` for any other."""
    parts = PurePosixPath(name.replace("\\", "/")).parts
    if not parts or name.startswith(("/", "\\")) or ".." in parts or ":" in parts[0] or "\0" in name:
        raise InputError(f"{source}: {name!r} is not a name inside the folder")
    return "/".join(parts)


def natural_key(name: str) -> list[tuple[int, int, str]]:
    """Sort key that puts t2 before t10 and agrees with plain sorting on zero-padded names."""
    return [(0, int(part), part) if part.isdecimal() else (1, 0, part) for part in re.split(r"(\d+)", name) if part]
