"""Structure from motion of the first visit's photographs, by COLMAP."""

import zlib  # noqa: F401, I001  (before pycolmap, whose own zlib otherwise takes over the process and aborts it)
import dataclasses
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pycolmap

from ltgs_jax.io import ColmapModel, InputError, Upright, read_colmap

from .retrieval import most_alike, photograph_descriptor

Progress = Callable[[str, int, int], None]
_MODEL = (
    "SIMPLE_RADIAL"  # focal length, centre, one radial term: what a phone's lens needs and few photographs determine
)
_GUESSED_FOCAL = 0.8  # of the longer side, where EXIF says nothing: between a phone's lens held upright and on its side


@dataclasses.dataclass(frozen=True)
class StructureConfig:
    """How structure from motion is done.

    `max_side` px at which keypoints are looked for; at most `max_features` a photograph; `contrast` SIFT's threshold;
    `max_ratio` Lowe's. Up to `all_pairs` photographs every pair is matched; beyond, each with its `following` next
    ones by name and the `retrieved` most alike. A set of at most `few` photographs, and one of which less than
    `enough` hang together, is matched with `more_features` and along epipolar lines, which takes several times longer.
    """

    max_side: int = 1600
    max_features: int = 4096
    contrast: float = 0.004
    max_ratio: float = 0.8
    all_pairs: int = 30
    following: int = 4
    retrieved: int = 12
    few: int = 12
    enough: float = 0.7
    more_features: int = 8192


@dataclasses.dataclass(frozen=True)
class Structure:
    """The largest model that was found; `left` names the photographs that are not in it.

    `error` is the mean reprojection error in pixels; `careful`, whether it took the slower way of matching.
    """

    model: ColmapModel
    left: tuple[str, ...]
    error: float
    careful: bool


def reconstruct(
    images: Path,
    photographs: Sequence[Upright],
    work: Path,
    *,
    masks: Path | None = None,
    config: StructureConfig = StructureConfig(),
    progress: Progress = lambda what, done, total: None,
) -> Structure:
    """Cameras and points of photographs that show one scene from many sides (Schönberger & Frahm 2016, by pycolmap).

    Photographs of one size and EXIF focal length share a camera. `work` keeps keypoints and matches: called again, it
    goes on from there. `masks` may hold `<name>.png` of each photograph: no keypoint is taken where it is 0. The frame
    is COLMAP's own, its scale arbitrary. Raises InputError that names `images` when no two photographs hang together.
    """
    careful = [True] if len(photographs) <= config.few else [False, True]
    best: Structure | None = None
    for care in careful:
        found = _attempt(images, photographs, work / ("careful" if care else "plain"), masks, config, care, progress)
        if found is not None and (best is None or len(found.left) < len(best.left)):
            best = found
        if best is not None and len(best.model.images) >= config.enough * len(photographs):
            break
    if best is None:
        raise InputError(
            f"{images}: the {len(photographs)} photographs do not hang together; each must share most of its view with "
            "the next, taken from another place (docs/photographs.md)"
        )
    return best


def _attempt(images, photographs, work, masks, config: StructureConfig, care: bool, progress) -> Structure | None:
    """One go; None when nothing came of it."""
    work.mkdir(parents=True, exist_ok=True)
    database = work / "database.db"
    level, pycolmap.logging.minloglevel = pycolmap.logging.minloglevel, 3  # what fails is told in our own words
    try:
        _extract(images, photographs, database, masks, config, care, progress)
        _match(images, photographs, database, config, care, progress)
        return _map(images, photographs, database, work / "models", care, progress)
    finally:
        pycolmap.logging.minloglevel = level


def _extract(images, photographs, database: Path, masks, config: StructureConfig, care: bool, progress) -> None:
    """Keypoints of each photograph, one camera for those of one size and focal length."""
    options = pycolmap.FeatureExtractionOptions()
    options.use_gpu = False
    options.max_image_size = config.max_side
    options.sift.max_num_features = config.more_features if care else config.max_features
    options.sift.peak_threshold = config.contrast / 2 if care else config.contrast
    cameras: dict[tuple[int, int, float | None], int] = _cameras(database, photographs)
    for i, p in enumerate(photographs):
        progress("keypoints", i, len(photographs))
        reader = pycolmap.ImageReaderOptions()
        reader.camera_model = _MODEL
        if masks is not None and (masks / f"{p.name}.png").is_file():
            reader.mask_path = masks
        kind = (p.width, p.height, p.focal)
        if kind in cameras:
            reader.existing_camera_id = cameras[kind]
        elif p.focal is not None:
            reader.camera_params = f"{p.focal!r},{p.width / 2!r},{p.height / 2!r},0"
        else:
            reader.default_focal_length_factor = _GUESSED_FOCAL
        pycolmap.extract_features(
            database, images, [p.name], pycolmap.CameraMode.SINGLE, reader, options, pycolmap.Device.cpu
        )
        if kind not in cameras:
            cameras |= _cameras(database, [p])


def _cameras(database: Path, photographs: Sequence[Upright]) -> dict[tuple[int, int, float | None], int]:
    """The cameras that the database has for each kind of photograph."""
    if not database.is_file():
        return {}
    with pycolmap.Database.open(database) as opened:
        known = {image.name: image.camera_id for image in opened.read_all_images()}
    return {(p.width, p.height, p.focal): known[p.name] for p in photographs if p.name in known}


def _match(images, photographs, database: Path, config: StructureConfig, care: bool, progress) -> None:
    """Matches of each photograph with some that come after it."""
    options = pycolmap.FeatureMatchingOptions()
    options.use_gpu = False
    options.sift.max_ratio = config.max_ratio + 0.05 if care else config.max_ratio
    options.guided_matching = care
    listed = database.with_name("pairs.txt")
    for i, others in enumerate(choose_pairs(images, photographs, config)):
        progress("matching", i, len(photographs))
        if others:
            listed.write_text("".join(f"{photographs[i].name} {photographs[j].name}\n" for j in others))
            pairing = pycolmap.ImportedPairingOptions()
            pairing.match_list_path = listed
            pycolmap.match_image_pairs(database, options, pairing, device=pycolmap.Device.cpu)


def choose_pairs(images: Path, photographs: Sequence[Upright], config: StructureConfig) -> list[list[int]]:
    """For each photograph the later ones that it is matched with."""
    n = len(photographs)
    if n <= config.all_pairs:
        return [list(range(i + 1, n)) for i in range(n)]
    looks = np.stack([photograph_descriptor(images / p.name) for p in photographs])
    pairs: set[tuple[int, int]] = set()
    for i in range(n):
        alike = most_alike(looks[i], looks, config.retrieved + 1).tolist()
        next_ones = range(i + 1, min(n, i + 1 + config.following))
        pairs |= {(min(i, j), max(i, j)) for j in (*alike, *next_ones) if j != i}
    return [sorted(j for a, j in pairs if a == i) for i in range(n)]


def _map(images, photographs, database: Path, models: Path, care: bool, progress) -> Structure | None:
    """Incremental mapping; the model with most photographs."""
    shutil.rmtree(models, ignore_errors=True)
    models.mkdir()
    placed = 0

    def one_more() -> None:
        nonlocal placed
        placed += 1
        progress("mapping", min(placed, len(photographs)), len(photographs))

    options = pycolmap.IncrementalPipelineOptions()
    options.min_model_size = min(3, len(photographs))
    found = pycolmap.incremental_mapping(database, images, models, options, next_image_callback=one_more)
    if not found:
        return None
    largest = max(found.values(), key=lambda model: (model.num_reg_images(), model.num_points3D()))
    kept = models / "largest"
    kept.mkdir()
    largest.write_binary(kept)
    model = read_colmap(kept)
    inside = {image.name for image in model.images.values()}
    left = tuple(p.name for p in photographs if p.name not in inside)
    return Structure(model, left, float(largest.compute_mean_reprojection_error()), care)
