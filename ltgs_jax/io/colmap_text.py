"""COLMAP models, written as text."""

from pathlib import Path

import numpy as np

from .colmap import ColmapModel
from .files import write_bytes


def write_colmap(folder: str | Path, model: ColmapModel) -> None:
    """Write `model` as cameras.txt, images.txt and points3D.txt, floats exactly. Raises InputError."""
    folder = Path(folder)
    cameras = [
        f"{identity} {lens.model} {lens.width} {lens.height} {_join(lens.params)}"
        for identity, lens in model.cameras.items()
    ]
    images = []
    for identity, image in model.images.items():
        images.append(f"{identity} {_join(image.quat)} {_join(image.xyz)} {image.camera_id} {image.name}")
        pairs = zip(image.pixels.tolist(), image.point_ids.tolist(), strict=True)
        images.append(" ".join(f"{x!r} {y!r} {point}" for (x, y), point in pairs))
    tracks: list[list[int]] = [[] for _ in model.point_ids]
    for point, image, index in model.track.tolist():
        tracks[point] += [image, index]
    points = [
        f"{identity} {_join(xyz)} {_join(color)} {float(error)!r}" + "".join(f" {value}" for value in track)
        for identity, xyz, color, error, track in zip(
            model.point_ids.tolist(), model.points, model.colors, model.errors, tracks, strict=True
        )
    ]
    for name, lines in (("cameras", cameras), ("images", images), ("points3D", points)):
        write_bytes(folder / f"{name}.txt", "".join(f"{line}\n" for line in lines).encode())


def _join(values) -> str:
    return " ".join(repr(value) for value in np.asarray(values).tolist())
