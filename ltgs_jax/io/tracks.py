"""tracks.json, checked against its JSON Schema before it is written and after it is read."""

import functools
import importlib.resources
import json
import math
from pathlib import Path
from typing import Any

from .files import InputError, plain_json, read_json, write_json

_TYPES: dict[str, tuple[type, ...]] = {
    "object": (dict,),
    "array": (list, tuple),
    "string": (str,),
    "boolean": (bool,),
    "integer": (int,),
    "number": (int, float),
    "null": (type(None),),
}


@functools.cache
def tracks_schema() -> dict:
    """The JSON Schema of tracks.json, which the package carries as tracks.schema.json."""
    return json.loads(importlib.resources.files("ltgs_jax.io").joinpath("tracks.schema.json").read_text())


def write_tracks(path: str | Path, *, visits: list[str], photographs: list[dict], objects: list[dict]) -> None:
    """Write tracks.json (contract.md) in one step; NumPy and JAX values become plain ones, non-finite ones null.

    Raises ValueError that says which value is not what the schema wants; InputError when the file cannot be written.
    """
    tracks = plain_json({"version": 1, "visits": visits, "photographs": photographs, "objects": objects})
    fault = find_fault(tracks, tracks_schema())
    if fault:
        raise ValueError(f"tracks: {fault}")
    write_json(path, tracks)


def read_tracks(path: str | Path) -> dict:
    """tracks.json as it stands. Raises InputError that names the file and the value that is wrong."""
    tracks = read_json(path)
    fault = find_fault(tracks, tracks_schema())
    if fault:
        raise InputError(f"{path}: {fault}")
    return tracks


def find_fault(value: Any, schema: dict, place: str = "") -> str | None:
    """The first place where `value` breaks `schema`, in words; None where it holds. The part of JSON Schema in use."""
    where = place or "the file"
    wanted = schema.get("type")
    if wanted is not None:
        names = [wanted] if isinstance(wanted, str) else wanted
        is_bool = isinstance(value, bool)
        fits = any(isinstance(value, _TYPES[name]) and (not is_bool or name == "boolean") for name in names)
        if not fits:
            return f"{where}: expected {' or '.join(names)}, got {value!r:.40}"
    if "const" in schema and value != schema["const"]:
        return f"{where}: expected {schema['const']!r}, got {value!r:.40}"
    if "enum" in schema and value not in schema["enum"]:
        return f"{where}: expected one of {', '.join(schema['enum'])}, got {value!r:.40}"
    if isinstance(value, dict):
        missing = [key for key in schema.get("required", ()) if key not in value]
        if missing:
            return f"{where}: has no {missing[0]}"
        items = [
            (f"{place}.{key}".lstrip("."), value[key], sub)
            for key, sub in schema.get("properties", {}).items()
            if key in value
        ]
        return next(filter(None, (find_fault(item, sub, name) for name, item, sub in items)), None)
    if isinstance(value, list | tuple):
        if not schema.get("minItems", 0) <= len(value) <= schema.get("maxItems", len(value)):
            return f"{where}: has {len(value)} entries"
        sub = schema.get("items", {})
        return next(filter(None, (find_fault(item, sub, f"{place}[{i}]") for i, item in enumerate(value))), None)
    if isinstance(value, int | float) and not isinstance(value, bool):
        low, high = schema.get("minimum", -math.inf), schema.get("maximum", math.inf)
        if not (math.isfinite(value) and low <= value <= high):
            return f"{where}: {value!r} is out of range"
    return None
