"""The options of each command, as frozen dataclasses that tyro parses, with errors on one line."""

import contextlib
import io
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Generic, Literal, TypeVar

import tyro
from tyro.conf import Positional

C = TypeVar("C")
Parsed = TypeVar("Parsed")


class UsageError(ValueError):
    """A command or an option is wrong; the message is one line that names it."""


@dataclass(frozen=True)
class Demo:
    """Make a small capture with known truth, run everything on it, print the scores; open nothing."""

    out: Path = Path("demo_out")
    """Folder of the chronology; the capture is made in its sub-folder `capture`."""
    scene: Literal["move", "turnover", "clutter", "nochange", "light"] = "turnover"
    """Which story the capture tells."""
    preset: Literal["fast", "paper", "tiny"] = "fast"
    """Options of the pipeline."""
    seed: int = 0
    """Chooses room, objects and events."""


@dataclass(frozen=True)
class Capture:
    """Make a capture of a folder of photographs, one sub-folder per visit: upright, with the cameras of all."""

    folder: Positional[Path]
    """Folder with one sub-folder of photographs per visit (of a video: its frames)."""
    out: Path
    """Folder of the capture; it must not hold anything yet."""
    visits: tuple[str, ...] = ()
    """The sub-folders in the order of the visits, the densely photographed one first; by name unless given."""
    first: int = 100
    """Most photographs of the first visit; of more, as of a video's frames, the sharpest of each stretch are kept."""
    later: int = 24
    """Most photographs of each later visit."""
    max_side: int = 1600
    """Longest side of the photographs in the capture, in pixels; 0 leaves their size as it is."""


@dataclass(frozen=True)
class Update(Generic[C]):
    """Find what changed in a capture, and give the scene at every visit. Run again, it resumes."""

    capture: Positional[Path]
    """Folder of photographs, one sub-folder per visit, and a COLMAP model."""
    out: Path
    """Folder of the chronology; made when it is missing."""
    config: Annotated[C, tyro.conf.arg(name="")]
    preset: Literal["fast", "paper", "tiny"] = "fast"
    """Where the options below start from."""
    initial: Path | None = None
    """A trained splat scene of the first visit (Inria layout), instead of fitting one."""
    seed: int = 0
    """Of everything that is drawn at random."""
    max_splats: int | None = None
    """Most splats of the fitted initial scene: the same as --fit.initial.max-splats."""
    max_side: int | None = None
    """Longest side in pixels at which photographs are worked on: the same as --io.max-side."""


@dataclass(frozen=True)
class Eval:
    """Score a chronology again from what is on disk, and write its report anew."""

    folder: Positional[Path]
    """Folder of the chronology."""
    capture: Path | None = None
    """The capture, if it has moved since."""


@dataclass(frozen=True)
class Render:
    """Write images of a visit."""

    folder: Positional[Path]
    """Folder of the chronology."""
    visit: str
    """Name of a visit, or its number from 0."""
    out: Path
    """Folder of the images."""
    camera: str | None = None
    """Name of a photograph, as `<visit>/<name>.jpg`: its camera alone."""
    all_test: bool = False
    """The cameras of all test photographs of every visit."""


@dataclass(frozen=True)
class Export:
    """Write a visit as splats, or all visits as a sequence, an animation of the objects, or a COLMAP model."""

    folder: Positional[Path]
    """Folder of the chronology."""
    out: Path
    """The file; a folder for ply-sequence, colmap and the chronologies."""
    format: Literal[
        "ply", "compressed-ply", "spz", "splat", "ply-sequence", "gltf", "colmap", "chronology-half", "chronology-8bit"
    ] = "ply"
    """ply, compressed-ply (SuperSplat), spz (Niantic), splat: one visit. ply-sequence: every visit, numbered, as
    SuperSplat plays them; gltf: the objects' poses as an animation (.glb); colmap: the cameras of all photographs;
    chronology-half, chronology-8bit: all visits in one file of half the size or a third, to render and export from."""
    visit: str | None = None
    """Name of a visit, or its number from 0; not for the formats that hold all of them."""
    capture: Path | None = None
    """The capture, if it has moved since; for colmap."""


@dataclass(frozen=True)
class View:
    """Look at a chronology in the browser, with a slider over visits."""

    folder: Positional[Path]
    """Folder of the chronology."""
    port: int = 8080
    """Of the local web server; the next free one is taken when it is in use."""
    host: str = "localhost"
    """Address to listen at; 0.0.0.0 lets other machines in."""


COMMANDS: dict[str, type] = {
    "demo": Demo,
    "capture": Capture,
    "update": Update,
    "eval": Eval,
    "render": Render,
    "export": Export,
    "view": View,
}


def parse(argv: Sequence[str]) -> Any:
    """The record of the command that `argv` names.

    Raises UsageError; asked for help, prints it and raises SystemExit(0).
    """
    if not argv or argv[0] in ("-h", "--help"):
        print(_overview())
        raise SystemExit(0 if argv else 2)
    name, *rest = argv
    if name == "--version":
        from ltgs_jax import __version__

        print(__version__)
        raise SystemExit(0)
    if name not in COMMANDS:
        raise UsageError(f"unknown command {name!r}; there are {', '.join(COMMANDS)}")
    if name == "update":
        return _parse_update(rest)
    return _parse(COMMANDS[name], rest, prog=f"ltgs {name}")


def _overview() -> str:
    width = max(map(len, COMMANDS)) + 2
    rows = [f"  {name:<{width}}{(record.__doc__ or '').strip()}" for name, record in COMMANDS.items()]
    return "\n".join(["usage: ltgs COMMAND …", "", *rows, "", "`ltgs COMMAND --help` lists the options of a command."])


def _parse_update(rest: Sequence[str]) -> Update:
    """Two passes: the preset says where the other options start from."""
    from ltgs_jax.pipeline import PRESETS, Config

    preset = "fast"
    for i, word in enumerate(rest):
        if word.startswith("--preset"):
            preset = word.partition("=")[2] or "".join(rest[i + 1 : i + 2])
    start = PRESETS.get(preset, PRESETS["fast"])  # an unknown name is refused below, with the list of names
    default = Update(capture=tyro.MISSING, out=tyro.MISSING, config=start)
    return _parse(Update[Config], rest, prog="ltgs update", default=default)


def _parse(record: type[Parsed], args: Sequence[str], *, prog: str, **options) -> Parsed:
    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said):
            return tyro.cli(record, args=list(args), prog=prog, **options)
    except SystemExit as stop:
        if not stop.code:
            raise
        raise UsageError(_one_line(said.getvalue())) from None


def _one_line(box: str) -> str:
    """The message in what tyro says: the first part of its box; after the title where it draws no box, for ASCII."""
    parts: list[list[str]] = [[]]
    for line in box.splitlines():
        words = line.strip(" │")
        if re.match(r"[╭╰]|[─-]{3,}$", words):
            parts.append([])
        elif words:
            parts[-1].append(words)
    told = [" ".join(words) for words in parts if words]
    message = told[0 if "│" in box else 1] if len(told) > ("│" not in box) else " ".join(told)
    return message.split(" For full helptext")[0] or "the options cannot be read"
