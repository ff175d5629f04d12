"""A capture's cameras as a COLMAP model, those of localised photographs included."""

from pathlib import Path

import numpy as np

from ltgs_jax.geometry import Camera

from .capture import Capture
from .colmap import ColmapImage, ColmapModel
from .colmap_text import write_colmap
from .lens import CameraModel
from .photographs import Photograph


def export_colmap(folder: str | Path, capture: Capture) -> None:
    """Write every photograph of `capture` that has a camera, and its points, as a COLMAP text model in `folder`.

    The camera of a photograph is its lens, which fits the stored (distorted) file. Put localised cameras into
    `capture.photographs` first. Raises InputError when the folder cannot be written.
    """
    cameras: dict[CameraModel, int] = {}
    images, track = {}, []
    seen = capture.point_observations
    for index, photograph in enumerate(capture.photographs):
        if photograph.camera is None:
            continue
        identity = len(images) + 1
        mine = np.flatnonzero(seen.photographs == index)
        pose = photograph.camera.cam_from_world
        quat = np.asarray(pose.quat, np.float64)
        images[identity] = ColmapImage(
            name=photograph.name,
            camera_id=cameras.setdefault(_lens(photograph, photograph.camera), len(cameras) + 1),
            quat=quat / np.linalg.norm(quat),
            xyz=np.asarray(pose.xyz, np.float64),
            pixels=seen.pixels[mine],
            point_ids=seen.points[mine] + 1,
        )
        track.append(np.column_stack([seen.points[mine], np.full(len(mine), identity), np.arange(len(mine))]))
    rows = np.concatenate([np.zeros((0, 3), np.int64), *track])
    model = ColmapModel(
        cameras={identity: lens for lens, identity in cameras.items()},
        images=images,
        point_ids=np.arange(1, len(capture.points) + 1),
        points=np.asarray(capture.points),
        colors=np.rint(np.clip(capture.point_colors, 0, 1) * 255).astype(np.uint8),
        errors=np.zeros(len(capture.points)),
        track=rows[np.lexsort((rows[:, 1], rows[:, 0]))],
    )
    write_colmap(folder, model)


def _lens(photograph: Photograph, camera: Camera) -> CameraModel:
    """The lens of a posed photograph; a pinhole where none is known."""
    if photograph.camera_model is not None:
        return photograph.camera_model
    K = np.asarray(camera.K, np.float64)
    params = tuple(float(v) for v in (K[0, 0], K[1, 1], K[0, 2], K[1, 2]))
    return CameraModel("PINHOLE", photograph.width, photograph.height, params)
