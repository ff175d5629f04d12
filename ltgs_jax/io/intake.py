"""A folder of photographs as it comes from a phone, made into the images/ of a capture."""

import dataclasses
import re
import shutil
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from .files import InputError, natural_key, replacing
from .images import SUFFIXES, as_rgb, read_header, read_pixels, resize_image, resize_mask, scaled_size, write_pixels

_VIDEOS = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm")
_REFUSED = (
    (
        (".heic", ".heif"),
        "HEIC is not read; convert them first, e.g. `for f in *.[Hh][Ee][Ii][Cc]; do heif-convert $f $f.jpg; done`",
    ),
    (
        (".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2"),
        "raw files are not read; develop them to JPEG first, e.g. `darktable-cli {0} {0}.jpg`",
    ),
    (
        _VIDEOS,
        "videos are not read; cut it into frames first, e.g. `mkdir visit && ffmpeg -i {0} -vf fps=2 visit/%04d.jpg`",
    ),
)
_MASKS = "masks"
_SHARPNESS_SIDE = 480  # pixels at which blur by a moving hand is still seen and grain is not


@dataclasses.dataclass(frozen=True)
class Intake:
    """One photograph on its way into a capture: where it lies, `<visit>/<file>` as it will be called.

    `mask` says what to ignore in it, 0 = ignore, in an image as large as the photograph is upright; None: nothing.
    """

    source: Path
    name: str
    mask: Path | None = None


@dataclasses.dataclass(frozen=True)
class Upright:
    """A photograph of a capture: size in pixels as written, focal length in pixels where EXIF gives it."""

    name: str
    width: int
    height: int
    focal: float | None


def find_intake(folder: str | Path, *, order: Sequence[str] = ()) -> tuple[dict[str, list[Intake]], list[str]]:
    """The photographs of each visit of a plain folder, and remarks: one sub-folder per visit, or photographs alone.

    Visits in natural order of their names, or in `order`. Visits and files are renamed where a COLMAP model or a
    capture could not hold their names. Masks are looked for as `masks/<visit>/<file>.png`, with or without the suffix
    of the photograph before `.png`, and as `masks/<visit>.png` for a whole visit. Raises InputError that names the
    folder or file: no photographs, formats that are not read (with the way to convert them), an `order` that does not
    name the visits.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder" if not folder.exists() else f"{folder}: expected a folder")
    visits = {path.name: path for path in sorted(folder.iterdir(), key=lambda p: natural_key(p.name)) if _shown(path)}
    remarks: list[str] = []
    loose = _photographs(folder)
    found = {name: files for name, path in visits.items() if (files := _photographs(path))}
    remarks += [f"{visits[name]}: no photographs in it; left out" for name in visits if name not in found]
    if not found and loose:
        found, loose = {folder.resolve().name or "visit": loose}, []
    if loose:
        remarks.append(f"{loose[0]} and {len(loose) - 1} more lie beside the visits' folders; left out")
    if not found:
        raise InputError(f"{folder}: no photographs found; expected one folder of photographs per visit")
    names = _ordered(list(found), order, folder)
    return {visit: _named(visit, found[name]) for name, visit in names.items()}, remarks


def _shown(path: Path) -> bool:
    return path.is_dir() and not path.name.startswith(".") and path.name != _MASKS


def _photographs(folder: Path) -> list[Path]:
    """Photographs of one folder. Raises InputError for those that must be converted first."""
    inside = [path for path in folder.iterdir() if not path.name.startswith(".") and path.is_file()]
    for suffixes, way in _REFUSED:
        refused = sorted(path for path in inside if path.suffix.lower() in suffixes)
        if refused and not (suffixes is _VIDEOS and any(p.suffix.lower() in SUFFIXES for p in inside)):
            raise InputError(f"{refused[0]} ({len(refused)} of its kind): {way.format(refused[0].name)}")
    kept = [path for path in inside if path.suffix.lower() in SUFFIXES]
    return sorted(kept, key=lambda path: natural_key(path.name))


def _ordered(found: list[str], order: Sequence[str], folder: Path) -> dict[str, str]:
    """Folder -> name of its visit, in order; names get a number where they would not sort that way."""
    if order and sorted(order) != sorted(found):
        raise InputError(f"--visits {' '.join(order)}: {folder} has {', '.join(found)}; name each of them once")
    folders = list(order) or found
    plain = [_plain(name) for name in folders]
    if plain != sorted(set(plain), key=natural_key):
        plain = [f"{i}_{name}" for i, name in enumerate(plain)]
    return dict(zip(folders, plain, strict=True))


def _named(visit: str, files: Sequence[Path]) -> list[Intake]:
    """Names that differ in more than the suffix."""
    taken: set[str] = set()
    named = []
    for path in files:
        stem, number = _plain(path.stem), 1
        while stem.lower() in taken:
            number += 1
            stem = f"{_plain(path.stem)}_{number}"
        taken.add(stem.lower())
        named.append(Intake(path, f"{visit}/{stem}{path.suffix.lower()}", _mask_of(path)))
    return named


def _mask_of(path: Path) -> Path | None:
    visit = path.parent.parent / _MASKS / path.parent.name
    choices = (visit / f"{path.name}.png", visit / f"{path.stem}.png", visit.with_name(f"{visit.name}.png"))
    return next((choice for choice in choices if choice.is_file()), None)


def _plain(name: str) -> str:
    """The name without what paths, lists and COLMAP's text files cannot hold."""
    return re.sub(r"[^\w.+-]+", "_", name).lstrip(".") or "_"


def sharpest(photographs: Sequence[Intake], most: int) -> list[Intake]:
    """At most `most` photographs: of each stretch of equal length the sharpest, as of the frames of a video.

    Sharpness is the variance of the Laplacian at 480 px. Those that cannot be read come last.
    """
    if len(photographs) <= most:
        return list(photographs)
    stretches = np.array_split(np.arange(len(photographs)), most)
    return [photographs[max(stretch, key=lambda i: _sharpness(photographs[i].source))] for stretch in stretches]


def _sharpness(path: Path) -> float:
    try:
        image = as_rgb(read_pixels(path))
    except InputError:
        return -1.0
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    small = resize_image(grey, scaled_size(grey.shape[1], grey.shape[0], _SHARPNESS_SIDE))
    return float(cv2.Laplacian(small, cv2.CV_32F).var())


def bring_in(photograph: Intake, images: Path, *, max_side: int | None) -> Upright:
    """Put a photograph into `images`, the right way up by EXIF and at most `max_side` px long.

    A file that is so already is copied as it is. What is there already stays, so that an interrupted intake goes on.
    Raises InputError that names the file when it is no photograph.
    """
    header = read_header(photograph.source)
    turned = header.orientation in (5, 6, 7, 8)
    upright = (header.height, header.width) if turned else (header.width, header.height)
    size = scaled_size(*upright, max_side)
    target = images / photograph.name
    if not target.is_file():
        if header.orientation == 1 and size == upright:
            with replacing(target) as beside:
                shutil.copyfile(photograph.source, beside)
        else:
            pixels = read_pixels(photograph.source, oriented=True)
            write_pixels(target, resize_image(pixels, size))
    focal = None if header.focal is None else header.focal * max(size) / max(upright)
    return Upright(photograph.name, *size, focal)


def bring_mask(photograph: Intake, upright: Upright, masks: Path) -> None:
    """Put the mask of a photograph, if it has one, beside it as `masks/<visit>/<file>.<suffix>.png`, COLMAP's habit.

    Raises InputError that names the mask when it is no image or has another shape than the photograph set upright.
    """
    if photograph.mask is None:
        return
    pixels = as_rgb(read_pixels(photograph.mask))
    height, width = pixels.shape[:2]
    if abs(width * upright.height - height * upright.width) > max(width, height, upright.width, upright.height):
        shape = f"{width}×{height}"
        raise InputError(f"{photograph.mask}: is {shape}, its photograph {upright.width}×{upright.height}")
    mask = resize_mask(pixels.max(axis=-1) > 0, (upright.width, upright.height))
    write_pixels(masks / f"{photograph.name}.png", (255 * mask).astype(np.uint8))
