"""From a folder of photographs to a capture: upright, with the cameras of every visit."""

import shutil
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

from ltgs_jax.io import (
    InputError,
    Upright,
    bring_in,
    bring_mask,
    export_colmap,
    find_intake,
    read_capture,
    read_json,
    sharpest,
    write_colmap,
    write_json,
)
from ltgs_jax.localize import LocalizeConfig, Structure, StructureConfig, localize, reconstruct

from .hold import only_run
from .store import digest

RECORD = "capture.json"
"""What became of each photograph; written last, so that a capture that has it is whole."""


@dataclass(frozen=True)
class IntakeConfig:
    """How a folder of photographs becomes a capture."""

    first: int = 100
    """Most photographs of the first visit; of more, as of a video's frames, the sharpest of each stretch are kept."""
    later: int = 24
    """Most photographs of each later visit."""
    max_side: int = 1600
    """Longest side in pixels of the photographs in the capture; 0 leaves their size as it is."""
    structure: StructureConfig = field(default_factory=StructureConfig)
    localize: LocalizeConfig = field(default_factory=LocalizeConfig)


def make_capture(
    folder: str | Path,
    out: str | Path,
    *,
    visits: Sequence[str] = (),
    config: IntakeConfig = IntakeConfig(),
    progress,
) -> dict:
    """Make a capture (contract.md) of a folder with one sub-folder of photographs per visit; returns its record.

    Structure from motion of the first visit, later visits placed against it, all cameras in `sparse/0`. `visits` gives
    the order where names do not. It is made in a folder beside `out` and renamed when it is whole; after an
    interruption the same call goes on from there. Raises InputError that names the folder, file or option.
    """
    folder, out = Path(folder), Path(out)
    found, remarks = find_intake(folder, order=visits)
    plan = {
        "version": 1,
        "source": str(folder.resolve()),
        "visits": list(found),
        "options": asdict(config),
        "files": [[p.name, str(p.source), p.source.stat().st_mtime_ns] for files in found.values() for p in files],
        "masks": [[str(m), m.stat().st_mtime_ns] for files in found.values() for p in files if (m := p.mask)],
    }
    if (out / RECORD).is_file():
        record = read_json(out / RECORD)
        if record.get("plan") != digest(plan):
            raise InputError(f"{out}: holds another capture; choose another --out")
        progress.note("it is there already, made from the same photographs")
        return record
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(f"{out}: is not an empty folder; choose another --out")
    for remark in remarks:
        progress.warn(remark)
    making = out.with_name(f".{out.name}.making")
    with only_run(making):
        _start_over_when_other(making, plan)
        record = {"plan": digest(plan), **_make(making, found, config, progress), "remarks": remarks}
        write_json(making / RECORD, record)
        shutil.rmtree(making / "work", ignore_errors=True)
        (making / "plan.json").unlink()
        if out.exists():
            out.rmdir()
    making.rename(out)
    return record


def _start_over_when_other(making: Path, plan: dict) -> None:
    """Empty the folder unless an interrupted run of the same plan left it."""
    path = making / "plan.json"
    if not path.is_file() or read_json(path).get("digest") != digest(plan):
        for name in ("images", "masks", "sparse", "work"):
            shutil.rmtree(making / name, ignore_errors=True)
        write_json(path, {"digest": digest(plan)})


def _make(making: Path, found: dict, config: IntakeConfig, progress) -> dict:
    """Photographs, structure, later visits; the record's content."""
    rows: dict[str, dict] = {}
    brought = _bring_all(making / "images", found, config, rows, progress)
    first = next(iter(found))
    largest = max(brought, key=lambda visit: len(brought[visit]))
    if len(brought[largest]) > 2 * len(brought[first]):
        progress.warn(f"the first visit, {first}, has fewer photographs than {largest}: --visits gives another order")
    if len(brought[first]) < 3:
        raise InputError(f"{first}: the first visit has {len(brought[first])} photographs; 3 are needed, 40 are better")
    progress.stage("structure from motion")
    structure = reconstruct(
        making / "images",
        brought[first],
        making / "work",
        masks=making / "masks",
        config=config.structure,
        progress=lambda what, done, total: progress.step(done, total, what),
    )
    progress.note(
        f"{len(structure.model.images)} of {len(brought[first])} photographs of {first} hang together: "
        f"{len(structure.model.points)} points, {structure.error:.2f} px"
    )
    write_colmap(making / "sparse" / "0", structure.model)
    progress.stage("placing the others")
    capture = read_capture(making)
    placed = localize(
        capture,
        config=config.localize,
        progress=lambda what, done, total: progress.step(done, total, what),
    )
    export_colmap(making / "sparse" / "0", placed.apply(capture))
    for status in placed.photographs:
        row = rows[status.name]
        row |= {"status": _status(status, structure), "inliers": status.inliers, "reason": status.reason}
        if status.reason is not None:
            progress.warn(f"{status.name}: left out, {status.reason}")
    return {
        "visits": list(found),
        "photographs": list(rows.values()),
        "points": len(structure.model.points),
        "error_px": round(structure.error, 4),
        "lenses": [asdict(lens) for lens in structure.model.cameras.values()],
    }


def _bring_all(images: Path, found: dict, config: IntakeConfig, rows: dict, progress) -> dict[str, list[Upright]]:
    """Every photograph that is used, in `images`; `rows` gets one entry for each that was found."""
    brought: dict[str, list[Upright]] = {visit: [] for visit in found}
    progress.stage("photographs")
    total, done = sum(map(len, found.values())), 0
    for t, (visit, files) in enumerate(found.items()):
        kept = {p.name for p in sharpest(files, config.first if t == 0 else config.later)}
        for photograph in files:
            row = {"name": photograph.name, "source": str(photograph.source), "inliers": None, "reason": None}
            progress.step(done, total, photograph.name)
            done += 1
            if photograph.name not in kept:
                rows[photograph.name] = row | {"status": "thinned out"}
                continue
            try:
                upright = bring_in(photograph, images, max_side=config.max_side or None)
                bring_mask(photograph, upright, images.with_name("masks"))
            except InputError as error:
                progress.warn(str(error))
                rows[photograph.name] = row | {"status": "rejected", "reason": str(error)}
                continue
            brought[visit].append(upright)
            rows[photograph.name] = row | {"status": "rejected", "exif_focal_px": upright.focal}
        if not brought[visit]:
            raise InputError(f"{files[0].source.parent}: none of its {len(files)} photographs can be read")
    return brought


def _status(status, structure: Structure) -> str:
    """`mapped` by structure from motion, `localized` against it, or `rejected`."""
    return "mapped" if status.status == "given" else status.status
