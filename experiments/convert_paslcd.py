"""Put a scene of the PASLCD examples into the capture layout.

    python -m experiments.convert_paslcd SRC OUT

`inst1_*` become the first visit, `inst2_*` (the same things under another light) the second, `inference_*` (after the
change) the last. Photographs are linked where the file system allows it, else copied; the COLMAP model is carried over
with its images renamed, so that every photograph of the model keeps its pose.
"""

import dataclasses
import os
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import tyro

from ltgs_jax import io

VISITS = (("inst1", "IMG_0000"), ("inst2", "IMG_0001"), ("inference", "IMG_0002"))


def link(source: Path, target: Path) -> None:
    """A link to the file where that works, else a copy."""
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        os.symlink(source.resolve(), target)
    except OSError:
        shutil.copyfile(source, target)


@contextmanager
def ends_in_one_line(name: str) -> Iterator[None]:
    """What is wrong with the input ends the program `name` with its message."""
    try:
        yield
    except io.InputError as error:
        sys.exit(f"{name}: {error}")


def convert(source: Path, out: Path) -> None:
    """Lay out the photographs and the model of `source` in `out`. Raises InputError that names what is missing."""
    if (out / "images").exists():
        raise io.InputError(f"{out}: already holds a capture")
    named = {}
    for prefix, visit in VISITS:
        photographs = sorted(source.glob(f"{prefix}_*.jp*g"))
        if not photographs:
            raise io.InputError(f"{source}: has no {prefix}_*.jpeg")
        for photograph in photographs:
            named[photograph.name] = f"{visit}/{photograph.name}"
            link(photograph, out / "images" / named[photograph.name])
    model_path = io.find_colmap(source)
    if model_path is not None:
        model = io.read_colmap(model_path)
        images = {
            identity: dataclasses.replace(image, name=named[image.name])
            for identity, image in model.images.items()
            if image.name in named
        }
        io.write_colmap(out / "sparse" / "0", dataclasses.replace(model, images=images))


def main(source: tyro.conf.Positional[Path], out: tyro.conf.Positional[Path]) -> None:
    """Convert a PASLCD scene in SOURCE to a capture in OUT."""
    with ends_in_one_line("convert_paslcd"):
        convert(source, out)


if __name__ == "__main__":
    tyro.cli(main)
