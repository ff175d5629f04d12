"""What each stage leaves on disk, and when it may be taken up again."""

import hashlib
import json
import resource
import sys
import time
from collections.abc import Callable
from copy import copy
from dataclasses import asdict, is_dataclass
from pathlib import Path
from typing import Any, TypeVar

import jax
import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load, save

from ltgs_jax.io import read_bytes, write_bytes, write_json

T = TypeVar("T")

_FORMAT = 5  # of what stages hold: none of another format is taken up


def digest(*parts: Any) -> str:
    """A name for inputs: dataclasses, arrays, bytes and plain values, by content."""
    sha = hashlib.sha256()
    for part in parts:
        if is_dataclass(part) and not isinstance(part, type):
            sha.update(json.dumps(asdict(part), sort_keys=True, default=str).encode())
        elif isinstance(part, np.ndarray | jax.Array):
            array = np.asarray(part)
            sha.update(f"{array.shape}{array.dtype}".encode() + array.tobytes())
        elif isinstance(part, bytes):
            sha.update(part)
        else:
            sha.update(json.dumps(part, sort_keys=True, default=str).encode())
        sha.update(b"\0")
    return sha.hexdigest()[:16]


class Store:
    """The stages of one run in `folder`/stages, each a safetensors file with a JSON header, keyed by its inputs."""

    prefix = ""

    def __init__(self, folder: Path, progress) -> None:
        self.folder = folder / "stages"
        self.summary = folder / "stages.json"
        self.progress = progress
        self.rows: list[dict] = []
        self.folder.mkdir(parents=True, exist_ok=True)

    def run(self, name: str, key: str, compute: Callable[[], tuple[dict[str, np.ndarray], dict]]) -> tuple[dict, dict]:
        """The arrays and notes of a stage: taken from disk when `key` is the same, else computed and written.

        `compute` returns arrays by name and notes that JSON can hold; notes["counts"] goes to stages.json.
        """
        name = self.prefix + name
        path, key = self.folder / f"{name}.safetensors", digest(_FORMAT, key)
        self.progress.stage(name)
        found = _read(path, key)
        if found is not None:
            arrays, header = found
            self.progress.note(f"{name}: taken from disk")
            self._row({**header["row"], "resumed": True})
            return arrays, header["notes"]
        started, cpu = time.perf_counter(), time.process_time()
        compiling = _compile_seconds()
        arrays, notes = compute()
        row = {
            "stage": name,
            "status": "done",
            "seconds": round(time.perf_counter() - started, 3),
            "cpu_seconds": round(time.process_time() - cpu, 3),
            "compile_seconds": round(_compile_seconds() - compiling, 3),
            "peak_bytes": _peak_bytes(),
            "counts": notes.get("counts", {}),
            "resumed": False,
        }
        header = {"key": key, "notes": json.dumps(notes), "row": json.dumps(row)}
        write_bytes(path, save({k: np.ascontiguousarray(v) for k, v in arrays.items()} or _NOTHING, header))
        self._row(row)
        return arrays, json.loads(header["notes"])

    def peek(self, name: str, key: str) -> tuple[dict[str, np.ndarray], dict] | None:
        """The arrays and notes of a stage as it was left by a run with another key; None where it was not."""
        found = _read(self.folder / f"{self.prefix}{name}.safetensors", digest(_FORMAT, key))
        return None if found is None else (found[0], found[1]["notes"])

    def again(self) -> "Store":
        """The same run's, for stages that are gone through a second time: `again_` goes before their names."""
        other = copy(self)
        other.prefix = "again_"
        return other

    def _row(self, row: dict) -> None:
        self.rows.append(row)
        write_json(self.summary, self.rows)


_NOTHING = {"nothing": np.zeros(1, np.float32)}


def _read(path: Path, key: str) -> tuple[dict[str, np.ndarray], dict] | None:
    """The stage on disk if it is whole and was made from the same inputs."""
    if not path.is_file():
        return None
    content = read_bytes(path)
    try:
        arrays = load(content)
        length = int.from_bytes(content[:8], "little")
        metadata = json.loads(content[8 : 8 + length])["__metadata__"]
        if metadata["key"] != key:
            return None
        return arrays, {"notes": json.loads(metadata["notes"]), "row": json.loads(metadata["row"])}
    except (SafetensorError, ValueError, KeyError, TypeError, RecursionError):
        return None


_compiled = {"seconds": 0.0, "listening": False}


def _compile_seconds() -> float:
    """Seconds that XLA spent compiling so far in this process, from JAX's own monitoring."""
    if not _compiled["listening"]:
        _compiled["listening"] = True

        def listen(event: str, duration: float, **_) -> None:
            if event.startswith("/jax/core/compile/"):
                _compiled["seconds"] += duration

        jax.monitoring.register_event_duration_secs_listener(listen)
    return _compiled["seconds"]


def _peak_bytes() -> int:
    """Largest resident size of this process so far."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else 1024 * peak
