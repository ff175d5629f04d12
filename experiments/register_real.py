"""Real depth captures: an object in its cluttered scene and successive views of a room, registered and drawn.

    python experiments/register_real.py --clouds FOLDER --out FOLDER

FOLDER holds PCD files. Features are fast point feature histograms (Rusu et al. 2009), matched among each other's
nearest. Writes an overlay per pair and real.json.
"""

import itertools
import json
import time
from dataclasses import dataclass
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import tyro
from scipy.spatial import cKDTree

from ltgs_jax.register import Result, match_features, register, verify_overlap

_BINS = 11


@dataclass(frozen=True)
class Options:
    """Where the clouds are and where the overlays go."""

    clouds: Path
    out: Path
    object_voxel: float = 0.006
    """Spacing of the object's points, metres."""
    room_voxel: float = 0.06
    """Spacing of the room's points, metres."""
    top_k: int = 3


def _decompress_lzf(data: bytes, size: int) -> bytes:
    """LZF: literal runs, and references to what was already written."""
    out = bytearray()
    at = 0
    while at < len(data):
        control = data[at]
        at += 1
        if control < 32:
            out += data[at : at + control + 1]
            at += control + 1
            continue
        length = control >> 5
        if length == 7:
            length += data[at]
            at += 1
        start = len(out) - ((control & 31) << 8) - data[at] - 1
        at += 1
        for index in range(start, start + length + 2):
            out.append(out[index])
    if len(out) != size:
        raise ValueError(f"compressed block: expected {size} bytes, got {len(out)}")
    return bytes(out)


def read_pcd(path: Path) -> np.ndarray:
    """Finite points [n 3] of a compressed binary PCD file of 4-byte fields, in metres."""
    data = path.read_bytes()
    marker = b"DATA binary_compressed\n"
    begin = data.index(marker) + len(marker)
    header = dict(line.split(" ", 1) for line in data[:begin].decode().splitlines() if " " in line)
    packed, size = np.frombuffer(data, np.uint32, 2, begin)
    columns = np.frombuffer(_decompress_lzf(data[begin + 8 : begin + 8 + packed], int(size)), np.float32)
    points = columns.reshape(-1, int(header["POINTS"]))[:3].T.astype(np.float64)
    return points[np.isfinite(points).all(1)]


def downsample(points: np.ndarray, voxel: float) -> np.ndarray:
    """Mean of the points of each cell."""
    _, cell = np.unique(np.floor(points / voxel).astype(np.int64), axis=0, return_inverse=True)
    sums = np.stack([np.bincount(cell.ravel(), points[:, k]) for k in range(3)], axis=1)
    return sums / np.bincount(cell.ravel())[:, None]


def normals_of(points: np.ndarray, tree: cKDTree, neighbours: int = 16) -> np.ndarray:
    """Unit normals that face the camera at the origin."""
    _, index = tree.query(points, neighbours)
    centred = points[index] - points[index].mean(1, keepdims=True)
    _, vectors = np.linalg.eigh(np.einsum("nki,nkj->nij", centred, centred))
    normals = vectors[:, :, 0]
    return normals * np.where(np.sum(normals * points, axis=1, keepdims=True) > 0, -1, 1)


def point_histograms(points: np.ndarray, voxel: float, neighbours: int = 60) -> np.ndarray:
    """Fast point feature histograms [n 33], neighbours within 5 voxels."""
    tree = cKDTree(points)
    normals = normals_of(points, tree)
    neighbours = min(neighbours, len(points) - 1)
    distance, index = tree.query(points, neighbours + 1)
    distance, index = distance[:, 1:], index[:, 1:]
    near = distance < 5 * voxel
    line = (points[index] - points[:, None]) / np.maximum(distance, 1e-12)[..., None]
    u = np.broadcast_to(normals[:, None], line.shape)
    v = np.cross(line, u)
    v /= np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-12)
    w = np.cross(u, v)
    other = normals[index]
    alpha, phi = np.sum(v * other, -1), np.sum(u * line, -1)
    theta = np.arctan2(np.sum(w * other, -1), np.sum(u * other, -1)) / np.pi
    simple = np.zeros((len(points), 3, _BINS))
    rows = np.broadcast_to(np.arange(len(points))[:, None], index.shape)
    for k, angle in enumerate((alpha, phi, theta)):
        bins = np.clip(((angle + 1) / 2 * _BINS).astype(int), 0, _BINS - 1)
        np.add.at(simple[:, k], (rows[near], bins[near]), 1)
    simple = simple.reshape(len(points), -1) / np.maximum(near.sum(1), 1)[:, None]
    weight = near / np.maximum(distance, 1e-12)
    blurred = np.einsum("nk,nkb->nb", weight, simple[index]) / np.maximum(weight.sum(1), 1e-12)[:, None]
    return simple + blurred


def draw_overlay(path: Path, title: str, moved: np.ndarray, dst: np.ndarray, focus: bool) -> None:
    """Both clouds from the front and from above; around the moved one where `focus`."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(14, 7), layout="constrained")
    low, high = (moved.min(0) - 0.15, moved.max(0) + 0.15) if focus else (dst.min(0), dst.max(0))
    for axis, (a, b) in zip(axes, ((0, 1), (0, 2)), strict=True):
        axis.scatter(dst[:, a], dst[:, b], s=0.5, color="tab:gray")
        axis.scatter(moved[:, a], moved[:, b], s=0.5, color="tab:red", alpha=0.6)
        axis.set(xlim=(low[a], high[a]), ylim=(high[b], low[b]) if b == 1 else (low[b], high[b]), aspect="equal")
        axis.set(xlabel="xyz"[a], ylabel="xyz"[b])
    figure.suptitle(title)
    figure.savefig(path, dpi=80)
    plt.close(figure)


def run_pair(options: Options, name: str, clouds: tuple[np.ndarray, np.ndarray], voxel: float, focus: bool) -> dict:
    """Register one pair of clouds, draw it, and say what came out."""
    src, dst = (downsample(cloud, voxel) for cloud in clouds)
    rows, cols, _ = match_features(
        *(np.sqrt(point_histograms(cloud, voxel)) for cloud in (src, dst)), top_k=options.top_k
    )
    register(src[rows], dst[cols], noise_bound=1.5 * voxel)
    start = time.perf_counter()
    answer = register(src[rows], dst[cols], noise_bound=1.5 * voxel)
    seconds = time.perf_counter() - start
    moved = np.asarray(answer.dst_from_src.apply(jnp.asarray(src, jnp.float32)))
    overlap = verify_overlap(answer.dst_from_src, jnp.asarray(src, jnp.float32), jnp.asarray(dst, jnp.float32))
    result = Result(int(answer.result))
    row = {
        "pair": name,
        "points": [len(src), len(dst)],
        "correspondences": len(rows),
        "inliers": int(answer.inliers),
        "result": result.name,
        "confidence": float(answer.confidence),
        "distinction": float(answer.distinction),
        "residual_m": float(answer.residual),
        "median_distance_m": float(np.median(cKDTree(dst).query(moved)[0])),
        "covered": float(overlap.src_covered),
        "seconds": seconds,
    }
    draw_overlay(options.out / f"{name}.png", f"{name}: {result.name}, {row['inliers']} inliers", moved, dst, focus)
    return row


def main(options: Options) -> None:
    """The milk carton in its scene, then each pair of successive captures."""
    options.out.mkdir(parents=True, exist_ok=True)
    rows = []
    carton = read_pcd(options.clouds / "milk.pcd")
    scene = read_pcd(options.clouds / "milk_cartoon_all_small_clorox.pcd")
    rows.append(run_pair(options, "milk", (carton, scene[scene[:, 2] < 2.0]), options.object_voxel, True))
    print(json.dumps(rows[-1]), flush=True)
    captures = sorted(options.clouds.glob("capture*.pcd"))
    views = [read_pcd(path) for path in captures]
    for (a, first), (b, second) in itertools.pairwise(zip(captures, views, strict=True)):
        rows.append(run_pair(options, f"{b.stem}_{a.stem}", (second, first), options.room_voxel, False))
        print(json.dumps(rows[-1]), flush=True)
    (options.out / "real.json").write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main(tyro.cli(Options))
