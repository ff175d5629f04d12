"""Put the living room of the LTGS authors into the capture layout with views to score: what their own system shows.

    python -m experiments.convert_livingroom SRC OUT

SRC is a capture with a folder `reference/<visit>/` of frames of later visits and `reference/poses.json`, their cameras.
These become test photographs, and so does every eighth of the first visit. They are no truth: the light is that of the
first visit, and what their system missed is missing. A caption lies at the same place in all: the mask of the first
visit's first photograph is that of each frame.
"""

import dataclasses
from pathlib import Path

import numpy as np
import tyro

from experiments.convert_paslcd import ends_in_one_line, link
from ltgs_jax import io
from ltgs_jax.io.colmap import ColmapImage
from ltgs_jax.io.lens import CameraModel

_HELD_OUT = 8  # of so many photographs of the first visit one is scored


def convert(source: Path, out: Path) -> None:
    """Lay out the capture and its frames in `out`. Raises InputError that names what is missing or wrong."""
    if (out / "images").exists():
        raise io.InputError(f"{out}: already holds a capture")
    poses = io.read_json(source / "reference" / "poses.json")
    found = io.find_colmap(source)
    if found is None:
        raise io.InputError(f"{source}: has no COLMAP model")
    for path in (p for folder in ("images", "masks") for p in (source / folder).rglob("*") if p.is_file()):
        link(path, out / path.relative_to(source))
    model = io.read_colmap(found)
    cameras, images = dict(model.cameras), dict(model.images)
    first = sorted(p.relative_to(source / "images") for p in (source / "images").glob("*_0000/*"))
    mask = source / "masks" / f"{first[0]}.png" if first else None
    scored, none = [str(p) for p in first[::_HELD_OUT]], (np.zeros((0, 2)), np.zeros(0, np.int64))
    for name, pose in sorted(poses.items()):
        visit, frame = name.split("/")
        lens = CameraModel(pose["model"], pose["width"], pose["height"], tuple(pose["params"]))
        camera = next((i for i, other in cameras.items() if other == lens), max(cameras, default=0) + 1)
        cameras[camera] = lens
        scored.append(f"{visit}/reference_{frame}")
        link(source / "reference" / name, out / "images" / scored[-1])
        if mask is not None and mask.is_file():
            link(mask, out / "masks" / f"{scored[-1]}.png")
        at = np.asarray(pose["wxyz"]), np.asarray(pose["xyz"])
        images[max(images, default=0) + 1] = ColmapImage(scored[-1], camera, *at, *none)
    io.write_colmap(out / "sparse" / "0", dataclasses.replace(model, cameras=cameras, images=images))
    (out / "images" / "test.txt").write_text("\n".join(scored) + "\n")


def main(source: tyro.conf.Positional[Path], out: tyro.conf.Positional[Path]) -> None:
    """Convert the living room in SOURCE to a capture in OUT."""
    with ends_in_one_line("convert_livingroom"):
        convert(source, out)


if __name__ == "__main__":
    tyro.cli(main)
