"""A capture so small that the whole main job runs on it in seconds: photographs are renders of known splats."""

from pathlib import Path

import jax.numpy as jnp
import numpy as np

from ltgs_jax.geometry import C0, SE3, Camera
from ltgs_jax.io import CameraModel, ColmapImage, ColmapModel, write_colmap, write_image, write_ply
from ltgs_jax.render import render
from ltgs_jax.scene import Splats, concatenate_splats

WIDTH, HEIGHT, FOCAL = 96, 72, 90.0


def _patch(points: np.ndarray, colors: np.ndarray, size: float) -> Splats:
    n = len(points)
    return Splats(
        means=jnp.asarray(points, jnp.float32),
        quats=jnp.tile(jnp.asarray([1.0, 0, 0, 0]), (n, 1)),
        log_scales=jnp.full((n, 3), np.log(size), jnp.float32),
        logit_opacities=jnp.full(n, 4.0, jnp.float32),
        sh=jnp.asarray((colors - 0.5) / C0, jnp.float32)[:, None],
    )


def _table(rng: np.random.Generator) -> Splats:
    xy = np.stack(np.meshgrid(np.linspace(-1, 1, 36), np.linspace(-1, 1, 36)), axis=-1).reshape(-1, 2)
    wood = 0.45 + 0.15 * np.sin(9 * xy[:, :1] + 3 * xy[:, 1:]) + 0.1 * rng.random((len(xy), 1))
    return _patch(np.c_[xy, np.zeros(len(xy))], wood * [1.0, 0.8, 0.6], 0.03)


def _box(rng: np.random.Generator, at: tuple[float, float]) -> Splats:
    points = rng.uniform([-0.16, -0.12, 0.0], [0.16, 0.12, 0.25], (260, 3)) + np.array([*at, 0])
    stripes = (np.floor(points[:, 2:] * 16) % 2) * [0.1, 0.5, 0.6]
    return _patch(points, 0.1 + stripes + 0.05 * rng.random((260, 3)), 0.025)


def _camera(turn: float, height: float = 1.3) -> Camera:
    """Looks at the table's middle from `turn` radians about it."""
    center = np.array([1.9 * np.cos(turn), 1.9 * np.sin(turn), height])
    forward = np.array([0, 0, 0.1]) - center
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0, 0, 1])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, -rotation @ center
    K = jnp.asarray([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]], jnp.float32)
    return Camera(SE3.from_matrix(jnp.asarray(matrix, jnp.float32)), K, WIDTH, HEIGHT)


def write_tiny_capture(folder: Path, *, moved: bool = True, again: bool = False, seed: int = 0) -> Path:
    """Two visits of a table with a box that has moved (or not), three where it then moves `again`; 6 photographs, then
    3 each, all posed; initial.ply is true."""
    rng = np.random.default_rng(seed)
    table = _table(rng)

    def with_box(*at: float) -> Splats:
        return concatenate_splats([table, _box(np.random.default_rng(seed + 1), at)])

    before = with_box(-0.35, 0.0)
    after = with_box(0.4, 0.2) if moved else before
    visits = [("t0", before, np.arange(6) * 1.05), ("t1", after, np.arange(3) * 2.1 + 0.4)]
    if again:
        visits.append(("t2", with_box(-0.1, -0.4), np.arange(3) * 2.1 + 0.9))
    lens = CameraModel("PINHOLE", WIDTH, HEIGHT, (FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2))
    images = {}
    none = np.zeros(0, np.int64)
    for visit, scene, turns in visits:
        for i, turn in enumerate(turns):
            camera = _camera(float(turn))
            noisy = np.asarray(render(scene, camera).image) + rng.normal(0, 0.01, (HEIGHT, WIDTH, 3))
            write_image(folder / "images" / visit / f"{i}.png", noisy)
            pose = camera.cam_from_world
            quat, xyz = np.asarray(pose.quat, np.float64), np.asarray(pose.xyz, np.float64)
            name = f"{visit}/{i}.png"
            images[len(images) + 1] = ColmapImage(name, 1, quat / np.linalg.norm(quat), xyz, np.zeros((0, 2)), none)
    points = np.asarray(before.means)[::10]
    write_colmap(
        folder / "sparse" / "0",
        ColmapModel(
            cameras={1: lens},
            images=images,
            point_ids=np.arange(1, len(points) + 1),
            points=points.astype(np.float64),
            colors=np.full((len(points), 3), 128, np.uint8),
            errors=np.zeros(len(points)),
            track=np.zeros((0, 3), np.int64),
        ),
    )
    write_ply(folder / "initial.ply", before)
    return folder
