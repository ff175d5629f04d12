"""Where the photographs of each visit lie, in each layout that is read."""

import dataclasses
import re
from pathlib import Path

from .files import InputError, natural_key, read_text
from .images import SUFFIXES

_IMAGES = (*SUFFIXES, ".heic", ".heif")  # the last two are named and refused, not overlooked

FLAT = "images"
"""Name of the only visit of a capture whose photographs lie in images/ itself."""


@dataclasses.dataclass(frozen=True)
class Layout:
    """Visits in order, and per visit the photographs as (name `<visit>/<file>`, path); `root` holds the lists."""

    root: Path
    visits: tuple[str, ...]
    photographs: tuple[tuple[tuple[str, Path], ...], ...]


def find_layout(folder: Path) -> Layout | None:
    """The visits of a capture by what is in its folder; None when it holds no photographs in any known way.

    In this order: `sparse/split.txt` (photograph, period); `images/<visit>/`; `t0/ t1/ …`; `rgb/` with `rgb_new/`;
    `images/` without folders, as one visit. Raises InputError for a visit without photographs.
    """
    images = folder / "images"
    split = folder / "sparse" / "split.txt"
    if split.is_file():
        return _of_split(images if images.is_dir() else folder, split)
    folders = _folders(images)
    if folders:
        return _of_folders(images, folders)
    periods = [path for path in _folders(folder) if re.fullmatch(r"t\d+", path.name)]
    if periods:
        return _of_folders(folder, periods)
    if (folder / "rgb").is_dir():
        names = ("rgb", "rgb_new") if (folder / "rgb_new").is_dir() else ("rgb",)
        return _of_folders(folder, [folder / name for name in names])
    flat = _files(images)
    if flat:
        return Layout(images, (FLAT,), (tuple((f"{FLAT}/{path.name}", path) for path in flat),))
    if images.is_dir():
        raise InputError(f"{images}: no visit in it; expected one folder of photographs per visit")
    return None


def _folders(folder: Path) -> list[Path]:
    if not folder.is_dir():
        return []
    inside = [path for path in folder.iterdir() if path.is_dir() and not path.name.startswith(".")]
    return sorted(inside, key=lambda path: natural_key(path.name))


def _files(folder: Path) -> list[Path]:
    if not folder.is_dir():
        return []
    inside = [p for p in folder.iterdir() if p.suffix.lower() in _IMAGES and not p.name.startswith(".") and p.is_file()]
    return sorted(inside, key=lambda path: natural_key(path.name))


def _of_folders(root: Path, folders: list[Path]) -> Layout:
    photographs = []
    for visit in folders:
        within = next((visit / name for name in ("images", "rgb") if (visit / name).is_dir()), visit)
        files = _files(within)
        if not files:
            raise InputError(f"{visit}: no photograph in this visit")
        photographs.append(tuple((f"{visit.name}/{path.name}", path) for path in files))
    return Layout(root, tuple(visit.name for visit in folders), tuple(photographs))


def _of_split(images: Path, split: Path) -> Layout:
    """Periods of `split.txt`, whose lines are a photograph and its period."""
    period_of = {}
    for number, line in enumerate(read_text(split).splitlines(), start=1):
        tokens = line.replace(",", " ").split()
        if not tokens or tokens[0].startswith("#"):
            continue
        if len(tokens) != 2:
            raise InputError(f"{split}: line {number}: expected a photograph and its period, got {line[:60]!r}")
        period_of[tokens[0]] = tokens[1]
    periods = sorted(set(period_of.values()), key=natural_key)
    if not periods:
        raise InputError(f"{split}: lists no photograph")
    visits = [period if re.search(r"\D", period) else f"t{period}" for period in periods]
    grouped: dict[str, list[tuple[str, Path]]] = {period: [] for period in periods}
    for path in _files(images):
        period = period_of.get(path.name, period_of.get(path.stem))
        if period is not None:
            grouped[period].append((f"{visits[periods.index(period)]}/{path.name}", path))
    for period, files in grouped.items():
        if not files:
            raise InputError(f"{split}: no photograph of period {period} is in {images}")
    safe = [visit for visit in visits if not re.fullmatch(r"[\w.+-]+", visit) or visit.startswith(".")]
    if safe:
        raise InputError(f"{split}: {safe[0]!r} cannot name a visit")
    return Layout(images, tuple(visits), tuple(tuple(grouped[period]) for period in periods))


def read_list(path: Path) -> list[str] | None:
    """The names in changes.txt or test.txt, one per line; None when the file is not there."""
    if not path.is_file():
        return None
    lines = (line.split("#", 1)[0].strip() for line in read_text(path).splitlines())
    return [line for line in lines if line]
