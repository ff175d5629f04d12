"""transforms.json of NeRF, nerfstudio and Blender: the one place where their axes are turned."""

import math
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from .colmap import ColmapImage, ColmapModel
from .files import InputError, natural_key, read_json, safe_name
from .images import SUFFIXES, read_header
from .layouts import Layout
from .lens import CameraModel, check_camera_model

# x right, y up, z backward (OpenGL, Blender) to x right, y down, z forward.
_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])


def read_transforms(folder: Path) -> tuple[ColmapModel, Layout]:
    """Cameras of `transforms.json` as a model without points, and the photographs by visit.

    A frame's visit is its `visit`, else its `time`, else the folder of its file below `images/`; visits are ordered by
    `time` where it is given, else by name. The model's images are named by their files' paths below `folder`.
    Raises InputError that names the file and the frame.
    """
    path = folder / "transforms.json"
    content = read_json(path)
    frames = content.get("frames")
    if not isinstance(frames, list) or not frames:
        raise InputError(f"{path}: has no frames")
    cameras: dict[CameraModel, int] = {}
    images, files, order = {}, {}, {}
    for number, frame in enumerate(frames):
        source = f"{path}: frame {number}"
        if not isinstance(frame, dict) or not isinstance(frame.get("file_path"), str):
            raise InputError(f"{source} has no file_path")
        file = _find(folder, safe_name(frame["file_path"].removeprefix("./"), source=source))
        visit = _visit(frame, file.relative_to(folder), source)
        name = f"{visit}/{file.name}"
        if name in files:
            raise InputError(f"{source}: a second photograph {name}")
        lens = _lens({**content, **frame}, file, source)
        pose = _pose(frame, source)
        quat = Rotation.from_matrix(pose[:3, :3]).as_quat()[[3, 0, 1, 2]]
        none = np.zeros((0, 2)), np.zeros(0, np.int64)
        identity = cameras.setdefault(lens, len(cameras) + 1)
        images[number + 1] = ColmapImage(file.relative_to(folder).as_posix(), identity, quat, pose[:3, 3], *none)
        files[name] = file
        order.setdefault(visit, frame.get("time", 0))
    visits = sorted(order, key=lambda visit: (_number(order[visit]), natural_key(visit)))
    grouped = tuple(
        tuple((n, f) for n, f in sorted(files.items(), key=lambda pair: natural_key(pair[0])) if n.startswith(f"{v}/"))
        for v in visits
    )
    model = ColmapModel(
        cameras={identity: lens for lens, identity in cameras.items()},
        images=images,
        point_ids=np.zeros(0, np.int64),
        points=np.zeros((0, 3)),
        colors=np.zeros((0, 3), np.uint8),
        errors=np.zeros(0),
        track=np.zeros((0, 3), np.int64),
    )
    return model, Layout(folder, tuple(visits), grouped)


def _number(value) -> float:
    return float(value) if isinstance(value, int | float) and math.isfinite(value) else 0.0


def _find(folder: Path, name: str) -> Path:
    """The photograph of a frame; Blender's files leave the suffix out."""
    file = folder / name
    return file if file.suffix.lower() in SUFFIXES else Path(f"{file}.png")


def _visit(frame: dict, file: Path, source: str) -> str:
    if "visit" in frame:
        return safe_name(str(frame["visit"]), source=source).replace("/", "_")
    parts = [part for part in file.parts[:-1] if part not in ("images", ".")]
    if parts:
        return parts[0]
    return f"t{_number(frame.get('time', 0)):g}"


def _lens(values: dict, file: Path, source: str) -> CameraModel:
    try:
        if not ("w" in values and "h" in values):
            header = read_header(file)
            values = {"w": header.width, "h": header.height, **values}
        width, height = int(values["w"]), int(values["h"])
        if "fl_x" in values:
            fx = float(values["fl_x"])
        elif "camera_angle_x" in values:
            fx = 0.5 * width / math.tan(0.5 * float(values["camera_angle_x"]))
        else:
            raise InputError(f"{source} has neither fl_x nor camera_angle_x")
        fy = float(values.get("fl_y", fx))
        cx, cy = float(values.get("cx", width / 2)), float(values.get("cy", height / 2))
        k1, k2, p1, p2, k3 = (float(values.get(name, 0)) for name in ("k1", "k2", "p1", "p2", "k3"))
    except (TypeError, ValueError, OverflowError, ZeroDivisionError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{source}: its intrinsics are not numbers ({error})") from None
    if k3 or "FISHEYE" in str(values.get("camera_model", "")):
        raise InputError(f"{source}: this lens model is not read; undistort the images first")
    model = ("OPENCV", (fx, fy, cx, cy, k1, k2, p1, p2)) if any((k1, k2, p1, p2)) else ("PINHOLE", (fx, fy, cx, cy))
    return check_camera_model(model[0], width, height, model[1], source=source)


def _pose(frame: dict, source: str) -> np.ndarray:
    """cam_from_world [4 4] in OpenCV axes of a frame's camera-to-world matrix in OpenGL axes."""
    try:
        matrix = np.array(frame.get("transform_matrix"), dtype=np.float64)
    except (TypeError, ValueError):
        matrix = np.zeros(0)
    if matrix.shape == (3, 4):
        matrix = np.vstack([matrix, [0, 0, 0, 1]])
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise InputError(f"{source}: transform_matrix is not a matrix of 4×4 numbers")
    rotation = matrix[:3, :3]
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-3 or np.linalg.det(rotation) < 0:
        raise InputError(f"{source}: transform_matrix does not hold a rotation")
    return np.linalg.inv(matrix @ _FLIP)
