"""What a finished run can be taken away as: splats of a visit, a sequence of all visits, poses, cameras."""

import dataclasses
from pathlib import Path

from ltgs_jax.io import (
    SPLAT_FORMATS,
    CameraModel,
    InputError,
    export_colmap,
    load_chronology,
    read_bytes,
    read_capture,
    save_chronology,
    write_bytes,
    write_gltf,
    write_ply,
    write_splats,
)
from ltgs_jax.scene import compose, drop_hidden

from .outputs import read_cameras

SMALL_FORMATS = {"chronology-half": "half", "chronology-8bit": "8-bit"}
"""Chronologies in less than full precision: a folder that is rendered, exported and read as the run's own."""
WHOLE_FORMATS = ("ply-sequence", "gltf", "colmap", *SMALL_FORMATS)
"""Formats that hold every visit: a folder of numbered PLYs, the objects' poses as an animation, a COLMAP model, and
chronologies."""
FORMATS = (*SPLAT_FORMATS, *WHOLE_FORMATS)


def export(
    folder: str | Path, form: str, out: str | Path, *, visit: int | None = None, capture: str | Path | None = None
) -> None:
    """Write a chronology's visit (SPLAT_FORMATS) or the whole of it (WHOLE_FORMATS) as `form`.

    `out` is a file, or a folder for `ply-sequence`, `colmap` and the chronologies. `colmap` takes photographs and
    points from `capture` (None: from where the capture was when the run was made). Raises InputError that names the
    option or the file.
    """
    folder, out = Path(folder), Path(out)
    if form not in FORMATS:
        raise InputError(f"--format {form}: expected one of {', '.join(FORMATS)}")
    if form in WHOLE_FORMATS and visit is not None:
        raise InputError(f"--visit: {form} holds all visits; leave it out")
    if form in SPLAT_FORMATS:
        if visit is None:
            raise InputError(f"--visit: is needed for --format {form}, which holds one visit")
        write_splats(out, drop_hidden(compose(load_chronology(folder), visit)), form=form)
    elif form == "ply-sequence":
        chronology = load_chronology(folder)
        for t in range(len(chronology.visits)):
            write_ply(out / f"{out.resolve().name}_{t:04d}.ply", drop_hidden(compose(chronology, t)))
    elif form == "gltf":
        if out.suffix.lower() != ".glb":
            raise InputError(f"--out {out}: glTF is written in its binary form; name a .glb file")
        write_gltf(out, load_chronology(folder))
    elif form in SMALL_FORMATS:
        if out.resolve() == folder.resolve():
            raise InputError(f"--out {out}: is the run's own folder; its chronology would be lost")
        save_chronology(out, load_chronology(folder), precision=SMALL_FORMATS[form])
        for name in ("tracks.json", "cameras.json"):
            write_bytes(out / name, read_bytes(folder / name))
    else:
        _export_cameras(folder, out, capture)


def _export_cameras(folder: Path, out: Path, capture_dir: str | Path | None) -> None:
    """A COLMAP model with every placed photograph of every visit, the later ones included."""
    recorded, cameras = read_cameras(folder)
    capture = read_capture(capture_dir if capture_dir is not None else recorded)
    photographs = []
    for p in capture.photographs:
        _, _, camera = cameras.get(p.name, (0, "", None))
        lens = p.camera_model
        if camera is not None and p.camera is None and not p.lens_given:
            K = camera.K.tolist()  # the lens that localisation found, which has no distortion
            lens = CameraModel("PINHOLE", camera.width, camera.height, (K[0][0], K[1][1], K[0][2], K[1][2]))
        photographs.append(dataclasses.replace(p, camera=camera, camera_model=lens))
    missing = sorted(cameras.keys() - {p.name for p in photographs})
    if missing:
        raise InputError(f"--capture {capture.folder}: has no photograph {missing[0]}, which the chronology knows")
    export_colmap(out, dataclasses.replace(capture, photographs=tuple(photographs)))
