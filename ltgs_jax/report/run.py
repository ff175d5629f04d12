"""What a finished run left on disk, as records; a file that is missing leaves its part empty."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from ltgs_jax.geometry import SE3, Camera
from ltgs_jax.io import InputError, read_json

_FAULTS = (KeyError, TypeError, ValueError, AttributeError, OverflowError, IndexError)
"""What reading values of the wrong kind raises."""

CHANGES = ("added", "removed", "moved", "new_state")


@dataclass(frozen=True)
class State:
    """One object at one visit, as in tracks.json; `pose` is world_from_template, None where it is not known."""

    visit: int
    event: str
    visible: bool
    pose: SE3 | None
    confidence: float | None
    ambiguous_axis: Any


@dataclass(frozen=True)
class Object:
    """One object; `center` [3] and `size` (diagonal) of its template in scene units; `states` by visit."""

    identity: int
    source_visit: int
    splats: int
    center: jax.Array
    size: float
    states: dict[int, State]

    def visible(self, visit: int) -> bool:
        """Whether it is there at a visit."""
        if visit in self.states:
            return self.states[visit].visible
        return visit == self.source_visit

    def pose(self, visit: int) -> SE3 | None:
        """Its pose at a visit; at its source visit the template's own frame unless tracks.json says otherwise."""
        if visit in self.states:
            return self.states[visit].pose
        return SE3.identity() if visit == self.source_visit else None


@dataclass(frozen=True)
class Shot:
    """One photograph of which there are images to show; a path is None where there is no such image."""

    name: str
    visit: int
    role: str
    capture: Path | None
    render: Path | None
    initial: Path | None
    mask: Path | None
    psnr: float | None
    initial_psnr: float | None
    camera: Camera | None


@dataclass(frozen=True)
class Placement:
    """How a photograph got its pose: `status` given, localized or rejected."""

    name: str
    status: str
    inliers: int | None
    reason: str | None


@dataclass(frozen=True)
class Run:
    """All that the page shows."""

    folder: Path
    capture: str
    visits: tuple[str, ...]
    objects: tuple[Object, ...]
    shots: tuple[Shot, ...]
    placements: tuple[Placement, ...]
    metrics: list[dict]
    stages: list[dict]
    config: dict
    env: dict


def read_run(folder: Path) -> Run:
    """Read the files of a chronology that the page needs.

    Raises InputError that names the file when tracks.json is missing or a file is not what contract.md says.
    """
    tracks = read_json(folder / "tracks.json")
    try:
        visits = tuple(str(visit) for visit in tracks["visits"])
        objects = tuple(_object(entry) for entry in tracks["objects"])
        placements = tuple(
            Placement(
                str(entry["name"]), str(entry["status"]), _whole(entry.get("inliers")), _text(entry.get("reason"))
            )
            for entry in tracks.get("photographs", [])
        )
        if any(not 0 <= visit < len(visits) for entry in objects for visit in (entry.source_visit, *entry.states)):
            raise ValueError("a visit beyond the list of visits")
    except _FAULTS as error:
        raise InputError(f"{folder / 'tracks.json'}: is not a list of tracks ({error})") from None
    manifest, placed = _optional(folder / "report.json", dict), _optional(folder / "cameras.json", dict)
    try:
        cameras = {name: _camera(entry) for name, entry in placed.get("photographs", {}).items()}
    except _FAULTS as error:
        raise InputError(f"{folder / 'cameras.json'}: is not a list of cameras ({error})") from None
    try:
        shots = tuple(_shot(entry, folder, visits, cameras) for entry in manifest.get("photographs", []))
        if any(not 0 <= shot.visit < len(visits) for shot in shots):
            raise ValueError("a visit beyond the list of visits")
    except _FAULTS as error:
        raise InputError(f"{folder / 'report.json'}: is not a list of photographs ({error})") from None
    capture = placed.get("capture")
    return Run(
        folder=folder,
        capture=Path(capture).name if isinstance(capture, str) else folder.resolve().name,
        visits=visits,
        objects=objects,
        shots=shots,
        placements=placements,
        metrics=_rows(folder / "metrics.json", named=("key",), words=("visit", "region", "unit", "direction")),
        stages=_rows(folder / "stages.json", named=(), words=("stage", "name", "status")),
        config=_optional(folder / "config.json", dict),
        env=_optional(folder / "env.json", dict),
    )


def _optional(path: Path, expected: type) -> Any:
    return read_json(path, expected) if path.exists() else expected()


def _rows(path: Path, *, named: tuple[str, ...], words: tuple[str, ...]) -> list[dict]:
    """A list of rows. Raises InputError when one is no row, lacks what is `named`, or has no text where words go."""
    rows = _optional(path, list)
    for i, row in enumerate(rows):
        sound = isinstance(row, dict) and all(isinstance(row.get(key), str) for key in named)
        if not sound or any(not isinstance(row.get(key), str | None) for key in words):
            raise InputError(f"{path}: row {i} is not what it should be ({row!r:.60})")
    return rows


def _real(value: Any) -> float | None:
    return None if value is None else float(value)


def _whole(value: Any) -> int | None:
    return None if value is None else int(value)


def _text(value: Any) -> str | None:
    return None if value is None else str(value)


def _object(entry: dict) -> Object:
    return Object(
        identity=int(entry["id"]),
        source_visit=int(entry["source_visit"]),
        splats=int(entry["splats"]),
        center=jnp.asarray(entry["center"], jnp.float32).reshape(3),
        size=float(entry["size"]),
        states={int(state["visit"]): _state(state) for state in entry["states"]},
    )


def _state(entry: dict) -> State:
    pose = entry.get("world_from_template")
    return State(
        visit=int(entry["visit"]),
        event=str(entry["event"]),
        visible=bool(entry["visible"]),
        pose=None if pose is None else _motion(pose),
        confidence=_real(entry.get("confidence")),
        ambiguous_axis=entry.get("ambiguous_axis"),
    )


def _shot(entry: dict, folder: Path, visits: tuple[str, ...], cameras: dict[str, Camera]) -> Shot:
    def path(key: str) -> Path | None:
        return folder / str(entry[key]) if entry.get(key) else None  # an absolute path stays as it is

    visit = entry["visit"]
    return Shot(
        name=str(entry["name"]),
        visit=visit if isinstance(visit, int) else visits.index(visit),
        role=str(entry.get("role", "")),
        capture=path("capture_path"),
        render=path("render_path"),
        initial=path("initial_render_path"),
        mask=path("mask_path"),
        psnr=_real(entry.get("psnr")),
        initial_psnr=_real(entry.get("initial_psnr")),
        camera=cameras.get(str(entry["name"])),
    )


def _camera(entry: dict) -> Camera:
    K = jnp.asarray(entry["K"], jnp.float32).reshape(3, 3)
    return Camera(_motion(entry["cam_from_world"]), K, int(entry["width"]), int(entry["height"]))


def _motion(entry: dict) -> SE3:
    return SE3(jnp.asarray(entry["wxyz"], jnp.float32).reshape(4), jnp.asarray(entry["xyz"], jnp.float32).reshape(3))
