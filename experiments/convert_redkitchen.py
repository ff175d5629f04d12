"""Put an RGB-D sequence in the layout of 7-Scenes into the capture layout: one visit, with points from its depth.

    python -m experiments.convert_redkitchen SRC OUT

The depth gives the sparse points that structure from motion would: a subsample of pixels is unprojected, kept where
other frames' depths agree, and observed there. Depth is used for nothing else.
"""

from pathlib import Path

import numpy as np
import tyro
from scipy.spatial.transform import Rotation

from experiments.convert_paslcd import ends_in_one_line, link
from ltgs_jax import io

VISIT = "IMG_0000"
DEPTH_MM = (100, 8000)
"""Depths in millimetres outside of which the Kinect's reading (0 and 65535 among them) says nothing."""


def _read_pose(path: Path) -> np.ndarray:
    """world_from_cam [4 4]; its rotation is made orthonormal, since the files round it."""
    pose = np.loadtxt(path).reshape(4, 4)
    u, _, vt = np.linalg.svd(pose[:3, :3])
    pose[:3, :3] = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
    return pose


def _project(points: np.ndarray, pose: np.ndarray, K: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    local = (points - pose[:3, 3]) @ pose[:3, :3]
    z = local[:, 2]
    safe = np.where(z > 1e-3, z, np.nan)
    return local[:, :2] / safe[:, None] * np.diag(K)[:2] + K[:2, 2], z


def _sparse_points(frames: list[dict], K: np.ndarray, count: int, tolerance: float):
    """Points, colours, and per frame which points it sees at which pixel."""
    rng = np.random.default_rng(0)
    per_frame = 3 * count // len(frames) + 1
    points, colors = [], []
    for frame in frames:
        rows, columns = np.nonzero(frame["valid"])
        chosen = rng.choice(len(rows), min(per_frame, len(rows)), replace=False)
        rows, columns = rows[chosen], columns[chosen]
        z = frame["depth"][rows, columns]
        xy = (np.stack([columns, rows], axis=1) + 0.5 - K[:2, 2]) / np.diag(K)[:2]
        local = np.column_stack([xy * z[:, None], z])
        points.append(local @ frame["pose"][:3, :3].T + frame["pose"][:3, 3])
        colors.append(frame["image"][rows, columns])
    order = rng.permutation(sum(len(block) for block in points))
    cloud, shades = np.concatenate(points)[order], np.concatenate(colors)[order]
    seen, pixels = [], []
    for frame in frames:
        xy, z = _project(cloud, frame["pose"], K)
        height, width = frame["depth"].shape
        inside = (z > 0.1) & (xy >= 0).all(axis=1) & (xy[:, 0] < width) & (xy[:, 1] < height)
        column, row = np.where(inside[:, None], xy, 0).astype(int).T
        seen.append(inside & frame["valid"][row, column] & (np.abs(frame["depth"][row, column] - z) < tolerance * z))
        pixels.append(xy)
    kept = np.flatnonzero(np.sum(seen, axis=0) >= 3)[:count]
    return cloud[kept], shades[kept], [s[kept] for s in seen], [p[kept] for p in pixels]


def convert(source: Path, out: Path, *, points: int = 20000, tolerance: float = 0.02) -> None:
    """Lay out colour frames, poses and points of `source` in `out`; `tolerance` is relative to the depth.

    Raises InputError that names what is missing.
    """
    if (out / "images").exists():
        raise io.InputError(f"{out}: already holds a capture")
    data = source / "data" if (source / "data").is_dir() else source
    colors = sorted(data.glob("*.color.jpg")) or sorted(data.glob("*.color.png"))
    if not colors:
        raise io.InputError(f"{data}: has no *.color.jpg")
    K = np.loadtxt(data / "camera-intrinsics.txt")
    # The file's principal point has the first pixel's centre at 0, as OpenCV.
    K[:2, 2] += 0.5
    frames = []
    for path in colors:
        stem = path.name.split(".")[0]
        depth = io.read_labels(data / f"{stem}.depth.png").astype(np.float64)
        valid = (depth > DEPTH_MM[0]) & (depth < DEPTH_MM[1])
        image = io.as_rgb(io.read_pixels(path))
        pose = _read_pose(data / f"{stem}.pose.txt")
        frames.append({"path": path, "depth": depth / 1000, "valid": valid, "image": image, "pose": pose})
    cloud, shades, seen, pixels = _sparse_points(frames, K, points, tolerance)
    height, width = frames[0]["depth"].shape
    images, track = {}, []
    for i, frame in enumerate(frames):
        mine = np.flatnonzero(seen[i])
        cam_from_world = np.linalg.inv(frame["pose"])
        quat = Rotation.from_matrix(cam_from_world[:3, :3]).as_quat(canonical=True)[[3, 0, 1, 2]]
        name = f"{VISIT}/{frame['path'].name}"
        images[i + 1] = io.ColmapImage(name, 1, quat, cam_from_world[:3, 3], pixels[i][mine], mine + 1)
        track.append(np.column_stack([mine, np.full(len(mine), i + 1), np.arange(len(mine))]))
        link(frame["path"], out / "images" / name)
    rows = np.concatenate(track)
    model = io.ColmapModel(
        cameras={1: io.CameraModel("PINHOLE", width, height, (K[0, 0], K[1, 1], K[0, 2], K[1, 2]))},
        images=images,
        point_ids=np.arange(1, len(cloud) + 1),
        points=cloud,
        colors=np.rint(shades * 255).astype(np.uint8),
        errors=np.zeros(len(cloud)),
        track=rows[np.lexsort((rows[:, 1], rows[:, 0]))],
    )
    io.write_colmap(out / "sparse" / "0", model)


def main(source: tyro.conf.Positional[Path], out: tyro.conf.Positional[Path], points: int = 20000) -> None:
    """Convert the RGB-D sequence in SOURCE to a capture in OUT with at most POINTS sparse points."""
    with ends_in_one_line("convert_redkitchen"):
        convert(source, out, points=points)


if __name__ == "__main__":
    tyro.cli(main)
