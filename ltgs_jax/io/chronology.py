"""Chronologies on disk: chronology.safetensors holds everything, chronology.json says in words what is in it."""

import dataclasses
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import safetensors.numpy

from ltgs_jax.geometry import SE3
from ltgs_jax.scene import Chronology, Shadows, Splats, Template

from .files import InputError, read_bytes, safe_name, write_bytes, write_json

M = TypeVar("M", bound=eqx.Module)

_VERSION = 2
_READ = (1, 2)  # version 1 has all coefficients of every splat in `sh`, and `since` of each
_DTYPES = ("float32", "float64")
_VISITS = ("uint8", "uint16", "uint32", "int32")
PRECISIONS = ("full", "half", "8-bit")
"""How the splats of a chronology are stored, but for their centres: as they are, in half precision, or each component
in 256 steps over its range."""


def _keys(name: str, kind: type[eqx.Module]) -> list[str]:
    """The arrays of a module of arrays, in order."""
    return [f"{name}.{field.name}" for field in dataclasses.fields(kind)]


def arrays_of(name: str, module: eqx.Module) -> dict[str, np.ndarray]:
    """The arrays of a module that has nothing else, as `name.field`."""
    return dict(zip(_keys(name, type(module)), map(np.asarray, jax.tree.leaves(module)), strict=True))


def module_of(kind: type[M], name: str, arrays: Mapping[str, np.ndarray]) -> M:
    """The module that `arrays_of` named."""
    return kind(*(arrays[key] for key in _keys(name, kind)))


def save_chronology(folder: str | Path, chronology: Chronology, *, precision: str = "full") -> None:
    """Write `chronology.safetensors` and its description `chronology.json`, each in one step, in one of `PRECISIONS`.

    The arrays file carries the description too, so that whichever moment a run is stopped at, it is whole by itself.
    Raises InputError when the folder cannot be written, ValueError for another precision.
    """
    if precision not in PRECISIONS:
        raise ValueError(f"precision: expected one of {', '.join(PRECISIONS)}, got {precision}")
    folder = Path(folder)
    arrays = {
        "world_from_template.quat": chronology.world_from_template.quat,
        "world_from_template.xyz": chronology.world_from_template.xyz,
        "visible": chronology.visible,
        "exposure": chronology.exposure,
    }
    if chronology.since is not None:
        arrays["background.since_runs"] = _runs(np.asarray(chronology.since))
    if chronology.shade is not None:
        arrays["shade"] = chronology.shade
    if chronology.shadows is not None:
        arrays |= arrays_of("shadows", chronology.shadows)
    parts = {"background": chronology.background}
    parts |= {f"templates.{k}": template.splats for k, template in enumerate(chronology.templates)}
    for name, splats in parts.items():
        for key, array in _lean(name, splats).items():
            arrays |= {key: array} if key == f"{name}.means" else _stored(key, array, precision)
    description = {
        "version": _VERSION,
        "visits": list(chronology.visits),
        "photographs": list(chronology.photographs),
        "templates": [
            {"identity": t.identity, "source_visit": t.source_visit, "splats": t.splats.count}
            for t in chronology.templates
        ],
        "background_splats": chronology.background.count,
    }
    content = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
    metadata = {"chronology": json.dumps(description)}
    write_bytes(folder / "chronology.safetensors", safetensors.numpy.save(content, metadata))
    write_json(folder / "chronology.json", description)


def _runs(values: np.ndarray) -> np.ndarray:
    """Values [n] as runs [r 2] of one value each, and its length."""
    starts = np.flatnonzero(np.diff(values, prepend=-1))
    return np.stack([values[starts], np.diff(starts, append=len(values))], axis=1).astype(np.int32)


def _lean(name: str, splats: Splats) -> dict[str, np.ndarray]:
    """The arrays of splats, with colours that depend on the direction only up to the last splat that has any."""
    arrays = arrays_of(name, splats)
    sh = arrays[f"{name}.sh"]
    if sh.shape[1] == 1:
        return arrays
    arrays[f"{name}.sh"], rest = sh[:, :1], sh[:, 1:]
    shining = np.flatnonzero(rest.any(axis=(1, 2)))
    return arrays | {f"{name}.sh_rest": rest[: shining[-1] + 1 if len(shining) else 0]}


def _stored(key: str, array: np.ndarray, precision: str) -> dict[str, np.ndarray]:
    """An array of splats [n …] as it is stored."""
    if precision == "full":
        return {key: array}
    if precision == "half":
        return {key: array.astype(np.float16)}
    low, high = (pick(array, axis=0) if len(array) else np.zeros(array.shape[1:]) for pick in (np.min, np.max))
    step = np.where(high > low, (high - low) / 255, 1)
    return {key: np.rint((array - low) / step).astype(np.uint8), f"{key}.range": np.stack([low, high]).astype("f4")}


def load_chronology(folder: str | Path) -> Chronology:
    """The chronology that `save_chronology` wrote: bit for bit, in the dtypes that it had (`since`: int32), or what is
    nearest to it, in float32, where it was stored in less than full precision.

    Raises InputError that names the file when it is missing, cut short, or does not fit together.
    """
    path = Path(folder) / "chronology.safetensors"
    content = read_bytes(path)
    description, arrays = _describe(content, path), _parse_arrays(content, path)
    visits = tuple(safe_name(name, source=path) for name in description["visits"])
    photographs = tuple(safe_name(name, source=path) for name in description["photographs"])
    rows = description["templates"]
    t, k, p = len(visits), len(rows), len(photographs)
    take = _Taker(arrays, path)
    n = description["background_splats"]
    templates = tuple(
        Template(take.splats(f"templates.{i}", row["splats"]), row["identity"], row["source_visit"])
        for i, row in enumerate(rows)
    )
    return Chronology(
        background=take.splats("background", n),
        templates=templates,
        world_from_template=SE3(
            take("world_from_template.quat", (t, k, 4)),
            take("world_from_template.xyz", (t, k, 3)),
        ),
        visible=take("visible", (t, k), dtypes=("bool",)),
        exposure=take("exposure", (p, 3, 2)),
        visits=visits,
        photographs=photographs,
        since=take.since(n),
        shade=take("shade", (t, k, 4)) if "shade" in arrays else None,
        shadows=take.shadows(t) if "shadows.cast" in arrays else None,
    )


def _header(content: bytes, path: Path) -> dict:
    """The JSON header of a safetensors file, its length believed only as far as the file reaches."""
    length = int.from_bytes(content[:8], "little")
    if len(content) < 8 or length > len(content) - 8:
        raise InputError(f"{path}: is cut short or not a safetensors file")
    try:
        header = json.loads(content[8 : 8 + length])
    except (ValueError, RecursionError):
        header = None
    if not isinstance(header, dict):
        raise InputError(f"{path}: its header is not JSON")
    return header


def _describe(content: bytes, path: Path) -> dict:
    """The description inside the arrays file, with the types that `load_chronology` goes by."""
    header = _header(content, path)
    try:
        description = json.loads(header["__metadata__"]["chronology"])
        version = description["version"]
        sound = (
            all(isinstance(name, str) for name in (*description["visits"], *description["photographs"]))
            and type(description["background_splats"]) is int
            and all(
                type(row[key]) is int
                for row in description["templates"]
                for key in ("identity", "source_visit", "splats")
            )
        )
    except (KeyError, TypeError, ValueError, RecursionError):
        raise InputError(f"{path}: does not describe a chronology") from None
    if version not in _READ:
        known = " and ".join(map(str, _READ))
        raise InputError(f"{path}: is of version {version}; this program reads versions {known}")
    if not sound or not description["visits"]:
        raise InputError(f"{path}: does not describe a chronology")
    return description


def _parse_arrays(content: bytes, path: Path) -> dict[str, np.ndarray]:
    try:
        return safetensors.numpy.load(content)
    except (safetensors.SafetensorError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path}: is not a whole safetensors file ({error})") from None


class _Taker:
    """Arrays by name, with the shape and kind that they must have."""

    def __init__(self, arrays: dict[str, np.ndarray], path: Path):
        self._arrays, self._path = arrays, path

    def __call__(self, name: str, shape: tuple[int, ...], *, dtypes: tuple[str, ...] = _DTYPES):
        array = self._arrays.get(name)
        if array is None:
            raise InputError(f"{self._path}: has no array {name}")
        if array.shape != shape or array.dtype.name not in dtypes:
            found = f"{array.dtype.name}{list(array.shape)}"
            raise InputError(f"{self._path}: {name} is {found}, expected {dtypes[0]}{list(shape)}")
        return jnp.asarray(array)

    def splats(self, name: str, n: int) -> Splats:
        """The splats under a name, any SH degree."""
        shapes = ((n, 3), (n, 4), (n, 3), (n,), (n, *self._found(f"{name}.sh", 1), 3))
        arrays = [self._restored(key, shape) for key, shape in zip(_keys(name, Splats), shapes, strict=True)]
        if (key := f"{name}.sh_rest") in self._arrays:
            rest = self._restored(key, (*self._found(key, 0), *self._found(key, 1), 3))
            if len(rest) > n:
                raise InputError(f"{self._path}: {key} has {len(rest)} rows for {n} splats")
            arrays[-1] = jnp.concatenate([arrays[-1], jnp.pad(rest, ((0, n - len(rest)), (0, 0), (0, 0)))], axis=1)
        if math.isqrt(k := arrays[-1].shape[1]) ** 2 != k:
            raise InputError(f"{self._path}: {name}.sh has {k} coefficients")
        return Splats(*arrays)

    def _found(self, key: str, axis: int) -> tuple[int, ...]:
        """The length that an array has along an axis, if it has one."""
        return self._arrays[key].shape[axis : axis + 1] if key in self._arrays else ()

    def _restored(self, key: str, shape: tuple[int, ...]):
        """What `_stored` stored."""
        array = self(key, shape, dtypes=(*_DTYPES, "float16", "uint8"))
        if array.dtype == jnp.uint8:
            low, high = self(f"{key}.range", (2, *shape[1:]), dtypes=("float32",))
            return low + array * ((high - low) / 255)
        return array.astype(jnp.float32) if array.dtype == jnp.float16 else array

    def since(self, n: int):
        """The visit from which on each of n splats shows, if there is such an array."""
        if (key := "background.since") in self._arrays:
            return self(key, (n,), dtypes=_VISITS).astype(np.int32)
        if (key := "background.since_runs") not in self._arrays:
            return None
        values, lengths = np.asarray(self(key, (*self._found(key, 0), 2), dtypes=_VISITS)).T
        if (lengths < 0).any() or lengths.sum() != n:
            raise InputError(f"{self._path}: {key} is not for {n} splats")
        return jnp.asarray(np.repeat(values, lengths).astype(np.int32))

    def shadows(self, t: int) -> Shadows:
        """The shadows of t visits."""
        m = self._arrays["shadows.cast"].shape[-1:] or (0,)
        shapes = ((*m, 3), m, m)
        *keys, cast = _keys("shadows", Shadows)
        arrays = [self(key, shape) for key, shape in zip(keys, shapes, strict=True)]
        return Shadows(*arrays, self(cast, (t, *m), dtypes=("bool",)))
