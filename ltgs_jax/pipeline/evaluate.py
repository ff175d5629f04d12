"""Scores from what is on disk: image quality per visit and region, and the changes where there is a truth."""

from pathlib import Path

import cv2
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from ltgs_jax.detect import dilate
from ltgs_jax.geometry import SE3, Camera
from ltgs_jax.io import InputError, load_image, load_mask, read_capture, read_json, read_labels, read_tracks, write_json
from ltgs_jax.metrics import (
    assign_objects,
    event_f1,
    flip,
    mask_f1,
    mask_iou,
    metric,
    psnr,
    rotation_deg,
    ssim,
    translation_rel,
)

from .outputs import read_cameras

_MARGIN = 5  # pixels by which the changed region is dilated


def evaluate(out_dir: str | Path, capture_dir: str | Path | None) -> list[dict]:
    """Score the renders, masks and tracks in `out_dir`, and write metrics.json.

    Test photographs of every later visit where there are any, else the photographs that were used. Region `changed`:
    what differs from the first visit, by the truth if there is one, else by the found objects, dilated by 5 px.
    `psnr_initial` is the score of the initial scene, untouched. Raises InputError when a file is missing.
    """
    out = Path(out_dir)
    recorded, cameras = read_cameras(out)
    capture = read_capture(capture_dir if capture_dir is not None else recorded)
    tracks = read_tracks(out / "tracks.json")
    truth = read_truth(capture.folder)
    rows = []
    manifest = read_json(out / "report.json")["photographs"]
    photographs = {p.name: p for p in capture.photographs}
    for t, visit in enumerate(capture.visits):
        shown = [e for e in manifest if e["visit"] == t and e["name"] in photographs]
        scored = [e for e in shown if e["role"] == "test"] or [e for e in shown if e["role"] == "update"]
        sums: dict[tuple[str, str], list[float]] = {}
        for entry in shown:
            photograph = photographs[entry["name"]]
            try:
                image, mask = load_image(photograph), load_mask(photograph)
            except InputError:  # named when the run tried to use it
                continue
            if image.shape[:2] != (cameras[photograph.name][2].height, cameras[photograph.name][2].width):
                raise InputError(f"{photograph.path}: its size is not that of its camera in {out / 'cameras.json'}")
            rendered = load_render(out / entry["render_path"], image.shape)
            untouched = load_render(out / entry["initial_render_path"], image.shape)
            entry["psnr"] = float(psnr(rendered, image, mask))
            entry["initial_psnr"] = float(psnr(untouched, image, mask))
            if entry not in scored:
                continue
            changed = _changed_region(out, entry, truth, cameras[photograph.name][2], rendered, untouched)
            for region, pixels in (("full", mask), ("changed", mask & changed), ("static", mask & ~changed)):
                if not pixels.any():
                    continue
                for key, value in _scores(rendered, image, pixels).items():
                    sums.setdefault((key, region), []).append(value)
                sums.setdefault(("psnr_initial", region), []).append(float(psnr(untouched, image, pixels)))
        for (key, region), values in sums.items():
            rows.append({**metric(key, float(np.mean(values)), visit=visit, region=region).to_json()})
            if key == "psnr_initial":
                rows[-1]["unit"] = "dB"
    if truth is not None:
        rows += _truth_scores(out, capture, tracks, truth, manifest)
    write_json(out / "report.json", {"photographs": manifest})
    write_json(out / "metrics.json", rows)
    return rows


def load_render(path: Path, shape: tuple[int, ...]) -> np.ndarray:
    """A render [h w 3] in 0…1; raises InputError when it is missing or of another size."""
    pixels = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if pixels is None or pixels.shape != shape:
        raise InputError(f"{path}: missing, or not of the photograph's size")
    return pixels[..., ::-1].astype(np.float32) / 255


def _scores(image, target, mask) -> dict[str, float]:
    """PSNR, SSIM and FLIP over the pixels that count."""
    return {
        "psnr": float(psnr(image, target, mask)),
        "ssim": float(ssim(image, target, mask)),
        "flip": float(flip(image, target, mask)),
    }


def read_truth(folder: Path) -> dict | None:
    """The truth that a made-up capture carries: ids, extents, poses per visit, and the folder of its masks."""
    path = folder / "truth" / "objects.json"
    if not path.is_file():
        return None
    content = read_json(path)
    return {**content, "masks": folder / "truth" / "masks"}


def _poses(truth: dict, t: int) -> dict[str, np.ndarray]:
    return {name: np.asarray(matrix, float) for name, matrix in truth["times"][t].items()}


def changed_names(truth: dict, a: int, b: int) -> set[str]:
    """Objects that are not the same at visits a and b."""
    before, after = _poses(truth, a), _poses(truth, b)
    return {
        name
        for name in before.keys() | after.keys()
        if name not in before or name not in after or not np.allclose(before[name], after[name], atol=1e-6)
    }


def middle_and_size(truth: dict, name: str, t: int) -> tuple[Float[np.ndarray, "3"], float]:
    """The middle of an object's box at visit t, and the diagonal of that box, in scene units."""
    pose, extents = _poses(truth, t)[name], np.asarray(truth["extents"][name], float)
    return pose[:3, :3] @ [0, 0, extents[2] / 2] + pose[:3, 3], float(np.linalg.norm(extents))


def true_motion(truth: dict, name: str, a: int, b: int) -> SE3 | None:
    """How an object moved between visits a and b, in the world; None where it is not there at b, or stands as at a."""
    start, goal = _poses(truth, a)[name], _poses(truth, b).get(name)
    if goal is None or np.allclose(goal, start, atol=1e-6):
        return None
    return SE3.from_matrix(jnp.asarray(goal @ np.linalg.inv(start), jnp.float32))


def _changed_region(out: Path, entry: dict, truth, camera: Camera, rendered, untouched) -> Bool[np.ndarray, "h w"]:
    """Pixels of a photograph in which the scene is not that of the first visit."""
    t = entry["visit"]
    if truth is None:
        return dilate(np.abs(rendered - untouched).max(axis=-1) > 0.08, _MARGIN)
    names = changed_names(truth, 0, t)
    labels = read_labels(truth["masks"] / Path(entry["name"]).with_suffix(".png"))
    region = np.isin(labels, [truth["ids"][name] for name in names])
    for name, pose in _poses(truth, 0).items():
        if name in names:
            region |= _box_outline(pose, np.asarray(truth["extents"][name], float), camera)
    return dilate(region, _MARGIN)


def _box_outline(pose: np.ndarray, extents: np.ndarray, camera: Camera) -> Bool[np.ndarray, "h w"]:
    """The outline of an object's box at a pose: where it stood at the first visit, in a photograph of another."""
    corners = np.stack(np.meshgrid([-0.5, 0.5], [-0.5, 0.5], [0.0, 1.0], indexing="ij"), axis=-1).reshape(-1, 3)
    world = (corners * extents) @ pose[:3, :3].T + pose[:3, 3]
    xy, z = camera.project(jnp.asarray(world, jnp.float32))
    outline = np.zeros((camera.height, camera.width), np.uint8)
    if np.all(np.asarray(z) > 1e-3):
        hull = cv2.convexHull(np.clip(np.asarray(xy), -1e4, 1e4).astype(np.float32))
        cv2.fillConvexPoly(outline, np.rint(hull - 0.5).astype(np.int32), 1)
    return outline.astype(bool)


def _truth_scores(out: Path, capture, tracks: dict, truth: dict, manifest: list[dict]) -> list[dict]:
    """Masks, identities, events and poses against the truth."""
    visits = range(1, len(capture.visits))
    ever = set().union(*[changed_names(truth, t - 1, t) for t in visits]) if len(capture.visits) > 1 else set()
    ids = truth["ids"]
    found_labels, true_labels = [], []
    for entry in manifest:
        if entry["mask_path"] is None:
            continue
        true = read_labels(truth["masks"] / Path(entry["name"]).with_suffix(".png"))
        found_labels.append(read_labels(out / entry["mask_path"]).astype(np.int64))
        true_labels.append(np.where(np.isin(true, [ids[name] for name in ever]), true, 0).astype(np.int64))
    assignment = assign_objects(found_labels, true_labels)
    assignment = {**assignment, **_assign_by_place(tracks, truth, assignment)}
    found_events = {(o["id"], s["visit"]): s["event"] for o in tracks["objects"] for s in o["states"]}
    true_events = _true_events(truth, len(capture.visits))
    rows = [metric("event_f1", event_f1(found_events, true_events, assignment), visit=None).to_json()]
    if found_labels:
        found = np.concatenate([(m > 0).ravel() for m in found_labels])
        true = np.concatenate([(m > 0).ravel() for m in true_labels])
        rows.append(metric("mask_iou", mask_iou(found, true), visit=None).to_json())
        rows.append(metric("mask_f1", mask_f1(found, true), visit=None).to_json())
    names = {value: name for name, value in ids.items()}
    rotations, translations = [], []
    for item in tracks["objects"]:
        name = names.get(assignment.get(item["id"], -1))
        source = item["source_visit"]
        if name is None or name not in truth["times"][source]:
            continue
        for state in item["states"]:
            motion = true_motion(truth, name, source, state["visit"])
            if not state["visible"] or state["visit"] <= source or motion is None:
                continue
            pose = state["world_from_template"]
            mine = SE3(jnp.asarray(pose["wxyz"], jnp.float32), jnp.asarray(pose["xyz"], jnp.float32))
            middle, size = middle_and_size(truth, name, source)
            rotations.append(rotation_deg(mine, motion))
            translations.append(translation_rel(mine, motion, center=middle, size=size))
    if rotations:
        rows.append(metric("rotation_deg", float(np.median(rotations)), visit=None).to_json())
        rows.append(metric("translation_rel", float(np.median(translations)), visit=None).to_json())
    return rows


def _assign_by_place(tracks: dict, truth: dict, assignment: dict[int, int]) -> dict[int, int]:
    """Partners for found objects that no later photograph shows: by where their template stood at the first visit."""
    partners = {}
    taken = set(assignment.values())
    for item in tracks["objects"]:
        if item["id"] in assignment or item["source_visit"] != 0:
            continue
        best, nearest = None, 0.5
        for name in _poses(truth, 0):
            middle, size = middle_and_size(truth, name, 0)
            distance = np.linalg.norm(np.asarray(item["center"]) - middle) / size
            if distance < nearest and truth["ids"][name] not in taken:
                best, nearest = truth["ids"][name], distance
        if best is not None:
            partners[item["id"]] = best
            taken.add(best)
    return partners


def _true_events(truth: dict, visits: int) -> dict[tuple[int, int], str]:
    """What happened to each object at each visit."""
    events = {}
    for t in range(1, visits):
        before, after = _poses(truth, t - 1), _poses(truth, t)
        for name in changed_names(truth, t - 1, t):
            kind = "added" if name not in before else "removed" if name not in after else "moved"
            events[truth["ids"][name], t] = kind
    return events
