"""COLMAP models, read without COLMAP: a corrupt file ends in a message, never in an abort of the process."""

import dataclasses
import struct
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from .files import InputError, read_bytes, read_text
from .lens import CameraModel, check_camera_model

# Order of COLMAP's camera model ids (src/colmap/sensor/models.h) and the number of parameters of each.
MODEL_IDS = (
    ("SIMPLE_PINHOLE", 3),
    ("PINHOLE", 4),
    ("SIMPLE_RADIAL", 4),
    ("RADIAL", 5),
    ("OPENCV", 8),
    ("OPENCV_FISHEYE", 8),
    ("FULL_OPENCV", 12),
    ("FOV", 5),
    ("SIMPLE_RADIAL_FISHEYE", 4),
    ("RADIAL_FISHEYE", 5),
    ("THIN_PRISM_FISHEYE", 12),
)
_POINT2D = np.dtype([("xy", "<f8", 2), ("point", "<i8")])


@dataclasses.dataclass(frozen=True)
class ColmapImage:
    """A registered image: `name`, camera, pose (`quat` wxyz, `xyz` of cam_from_world), its q keypoints.

    `pixels` [q 2] with the image's corner at (0, 0); `point_ids` [q], -1 where the keypoint has no 3D point.
    """

    name: str
    camera_id: int
    quat: np.ndarray
    xyz: np.ndarray
    pixels: np.ndarray
    point_ids: np.ndarray


@dataclasses.dataclass(frozen=True)
class ColmapModel:
    """A sparse reconstruction: m points, `track` rows (point index, image id, index of the keypoint)."""

    cameras: dict[int, CameraModel]
    images: dict[int, ColmapImage]
    point_ids: np.ndarray
    points: np.ndarray
    colors: np.ndarray
    errors: np.ndarray
    track: np.ndarray


def find_colmap(folder: str | Path) -> Path | None:
    """The COLMAP model of a capture: sparse/0, sparse, colmap/sparse/0 or the folder itself; None without one."""
    folder = Path(folder)
    for candidate in (folder / "sparse" / "0", folder / "sparse", folder / "colmap" / "sparse" / "0", folder):
        if any((candidate / f"cameras{suffix}").is_file() for suffix in (".bin", ".txt")):
            return candidate
    return None


def read_colmap(folder: str | Path) -> ColmapModel:
    """A COLMAP model, binary or text (binary when both are there).

    Raises InputError that names the file when one is missing, cut short or not what it should be.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder")
    suffix = ".bin" if (folder / "cameras.bin").is_file() else ".txt"
    cameras_path, images_path, points_path = (folder / f"{name}{suffix}" for name in ("cameras", "images", "points3D"))
    binary = suffix == ".bin"
    cameras = (_binary_cameras if binary else _text_cameras)(cameras_path)
    images = (_binary_images if binary else _text_images)(images_path)
    points = (_binary_points if binary else _text_points)(points_path) if points_path.is_file() else ([], [], [])
    for image in images.values():
        if image.camera_id not in cameras:
            raise InputError(f"{images_path}: image {image.name!r} has camera {image.camera_id}, which is not there")
        if not (np.isfinite(image.quat).all() and np.isfinite(image.xyz).all() and np.any(image.quat)):
            raise InputError(f"{images_path}: the pose of image {image.name!r} is not a pose")
    return _assemble(cameras, images, *points, path=points_path)


def _assemble(cameras, images, ids, rows, tracks, *, path: Path) -> ColmapModel:
    """Points and tracks as arrays; track entries that point at nothing are left out."""
    values = np.array(rows, dtype=np.float64).reshape(-1, 7)
    if not np.isfinite(values[:, :3]).all():
        raise InputError(f"{path}: {int((~np.isfinite(values[:, :3])).any(axis=1).sum())} points are not finite")
    lengths = np.array([len(track) for track in tracks], dtype=np.int64)
    pairs = np.concatenate(tracks) if tracks else np.zeros((0, 2), np.int64)
    track = np.column_stack([np.repeat(np.arange(len(tracks)), lengths), pairs]).astype(np.int64)
    keypoints = {identity: len(image.pixels) for identity, image in images.items()}
    known = np.array([0 <= index < keypoints.get(image, 0) for _, image, index in track.tolist()], dtype=bool)
    return ColmapModel(
        cameras=cameras,
        images=images,
        point_ids=np.array(ids, dtype=np.int64),
        points=values[:, :3],
        colors=np.clip(values[:, 3:6], 0, 255).astype(np.uint8),
        errors=values[:, 6],
        track=track[known],
    )


class _Cursor:
    """Sequential reads of little-endian values that end in an InputError at the end of the file."""

    def __init__(self, path: Path):
        self.path, self.content, self.at = path, read_bytes(path), 0

    def take(self, form: str) -> tuple:
        size = struct.calcsize("<" + form)
        self.need(size)
        values = struct.unpack_from("<" + form, self.content, self.at)
        self.at += size
        return values

    def need(self, size: int) -> None:
        """A count in a header is believed only if the file is long enough for it."""
        if size > len(self.content) - self.at:
            raise InputError(f"{self.path}: cut short at byte {len(self.content)}, {size} more expected at {self.at}")

    def array(self, dtype: np.dtype, count: int) -> np.ndarray:
        self.need(dtype.itemsize * count)
        values = np.frombuffer(self.content, dtype, count, self.at)
        self.at += dtype.itemsize * count
        return values

    def text(self) -> str:
        end = self.content.find(b"\0", self.at)
        if end < 0:
            raise InputError(f"{self.path}: cut short within a name at byte {self.at}")
        name = self.content[self.at : end].decode("utf-8", "replace")
        self.at = end + 1
        return name


def _binary_cameras(path: Path) -> dict[int, CameraModel]:
    cursor = _Cursor(path)
    cameras = {}
    for _ in range(cursor.take("Q")[0]):
        identity, model_id, width, height = cursor.take("iiQQ")
        if not 0 <= model_id < len(MODEL_IDS):
            raise InputError(f"{path}: camera {identity} has the unknown model {model_id}")
        model, count = MODEL_IDS[model_id]
        params = cursor.take(f"{count}d")
        cameras[identity] = check_camera_model(model, width, height, params, source=f"{path}: camera {identity}")
    return cameras


def _binary_images(path: Path) -> dict[int, ColmapImage]:
    cursor = _Cursor(path)
    images = {}
    for _ in range(cursor.take("Q")[0]):
        identity, *pose, camera_id = cursor.take("i7di")
        name = cursor.text()
        points = cursor.array(_POINT2D, cursor.take("Q")[0])
        quat, xyz = np.array(pose[:4]), np.array(pose[4:])
        images[identity] = ColmapImage(name, camera_id, quat, xyz, points["xy"].copy(), points["point"].copy())
    return images


def _binary_points(path: Path) -> tuple[list, list, list]:
    cursor = _Cursor(path)
    ids, rows, tracks = [], [], []
    for _ in range(cursor.take("Q")[0]):
        identity, *row, length = cursor.take("Q3d3BdQ")
        ids.append(identity & 0x7FFFFFFFFFFFFFFF)
        rows.append(row)
        tracks.append(cursor.array(np.dtype("<i4"), 2 * length).reshape(-1, 2))
    return ids, rows, tracks


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    """Numbered lines without comments; empty lines stay, because they mean something in images.txt."""
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        if not line.startswith("#"):
            yield number, line.strip()


def _numbers(path: Path, number: int, tokens: list[str]) -> np.ndarray:
    try:
        return np.array(tokens, dtype=np.float64)
    except ValueError:
        raise InputError(f"{path}: line {number}: expected numbers, got {' '.join(tokens)[:60]!r}") from None


def _integers(values: np.ndarray) -> np.ndarray:
    """Identifiers read as floats; what none can be becomes −1, as COLMAP marks keypoints without a point."""
    return np.where(np.abs(values) < 2**53, values, -1).astype(np.int64)


def _text_cameras(path: Path) -> dict[int, CameraModel]:
    cameras = {}
    for number, line in _lines(path):
        if not line:
            continue
        tokens = line.split()
        if len(tokens) < 5:
            raise InputError(f"{path}: line {number}: expected id, model, width, height, parameters; got {line[:60]!r}")
        values = _numbers(path, number, [tokens[0], *tokens[2:]])
        if not np.isfinite(values).all():
            raise InputError(f"{path}: line {number}: a value is not finite")
        identity, width, height = (int(value) for value in values[:3])
        source = f"{path}: line {number}"
        cameras[identity] = check_camera_model(tokens[1], width, height, tuple(values[3:].tolist()), source=source)
    return cameras


def _is_image_line(tokens: list[str]) -> bool:
    """Whether a line names an image; a line of keypoints has numbers alone, in threes."""
    if len(tokens) < 10:
        return False
    try:
        float(tokens[9])
    except ValueError:
        return True
    return len(tokens) % 3 != 0


def _text_images(path: Path) -> dict[int, ColmapImage]:
    images = {}
    lines = list(_lines(path))
    at = 0
    while at < len(lines):
        number, line = lines[at]
        at += 1
        if not line:
            continue
        tokens = line.split(maxsplit=9)
        if len(tokens) < 10:
            raise InputError(f"{path}: line {number}: expected an image of 10 values, got {line[:60]!r}")
        values = _numbers(path, number, tokens[:9])
        keypoints: list[str] = []
        # Files written by hand often lack the second, empty line of an image.
        if at < len(lines) and not _is_image_line(lines[at][1].split()):
            keypoints = lines[at][1].split()
            at += 1
        table = _numbers(path, number + 1, keypoints)
        if len(table) % 3:
            raise InputError(f"{path}: line {number + 1}: expected keypoints as x, y, point; got {len(table)} values")
        table = table.reshape(-1, 3)
        identity, camera_id = _integers(values[[0, 8]]).tolist()
        point_ids = _integers(table[:, 2])
        images[identity] = ColmapImage(tokens[9], camera_id, values[1:5], values[5:8], table[:, :2], point_ids)
    return images


def _text_points(path: Path) -> tuple[list, list, list]:
    ids, rows, tracks = [], [], []
    for number, line in _lines(path):
        if not line:
            continue
        values = _numbers(path, number, line.split())
        if len(values) < 7 or len(values) not in (7, *range(8, len(values) + 1, 2)) or not np.isfinite(values).all():
            raise InputError(f"{path}: line {number}: expected id, x y z, r g b, error, track; got {line[:60]!r}")
        ids.append(int(_integers(values[:1])[0]))
        rows.append([*values[1:7], values[7] if len(values) > 7 else 0.0])
        tracks.append(_integers(values[8:]).reshape(-1, 2))
    return ids, rows, tracks
