"""What runs work on: built-in captures, made once under OUT/captures and found again, or a folder of the user's.

`CaptureConfig(scene="turnover", seed=0)` is made by the generator behind `ltgs demo`; a `scene` that is a path is
read as it is. `pose_noise` shakes the given poses of the later visits' photographs, those that a method may use: the
held-out ones keep theirs.
"""

import dataclasses
import hashlib
import json
import shutil
import zlib  # noqa: F401  (before pycolmap, which brings its own)
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from ltgs_jax.demo.capture import make_capture
from ltgs_jax.demo.story import SCENES
from ltgs_jax.io import find_colmap, read_capture, read_colmap, write_colmap


@dataclass(frozen=True)
class CaptureConfig:
    """A capture to work on."""

    scene: str = "turnover"
    """move, turnover, clutter, nochange, light (made here), or a folder."""
    seed: int = 0
    width: int = 160
    height: int = 120
    dense: int = 20
    """Photographs of the first visit."""
    update: int = 3
    """Photographs of each later visit, besides the held-out."""
    used: int | None = None
    """How many of these may be used, spread over all; None: all. What is held out stays the same."""
    test: int = 4
    """Held-out photographs of each visit."""
    points: int = 2000
    pose_noise: float = 0.0
    """Standard deviation of the noise on later visits' given poses: degrees, and hundredths of a scene unit."""

    @property
    def built_in(self) -> bool:
        """Whether it is made here."""
        return self.scene in SCENES

    @property
    def label(self) -> str:
        """Short name in tables."""
        return f"{self.scene} {self.seed}" if self.built_in else Path(self.scene).name


def open_capture(config: CaptureConfig, cache: Path) -> Path:
    """The capture's folder, made now when it is a built-in one that is not there yet."""
    if not config.built_in:
        return Path(config.scene)
    name = hashlib.sha256(json.dumps(dataclasses.asdict(config), sort_keys=True).encode()).hexdigest()[:12]
    folder = cache / "captures" / f"{config.scene}_{config.seed}_{name}"
    if folder.is_dir():
        return folder
    part = folder.with_name(f"{folder.name}.{np.random.default_rng().integers(1 << 62):x}.part")
    options = {
        key: getattr(config, key) for key in ("scene", "seed", "width", "height", "dense", "update", "test", "points")
    }
    make_capture(part, **options)
    if config.used is not None:
        _set_aside(part, config)
    if config.pose_noise > 0:
        _shake_poses(part, config)
    try:
        part.rename(folder)
    except OSError:  # another process was quicker; the same arguments give the same files
        shutil.rmtree(part)
    return folder


def dense_later(config: CaptureConfig, count: int) -> CaptureConfig:
    """The same rooms and visits with `count` photographs at each visit: for the bound of fitting every visit anew."""
    return dataclasses.replace(config, update=count, used=None, pose_noise=0.0)


def _set_aside(folder: Path, config: CaptureConfig) -> None:
    """Of each visit's photographs, those that may not be used, off the list of those that may."""
    path = folder / "images" / "changes.txt"
    names = path.read_text().split()
    chosen = set(np.linspace(0, config.update - 1, config.used).round().astype(int).tolist())
    path.write_text("".join(f"{name}\n" for i, name in enumerate(names) if i % config.update in chosen))


def _shake_poses(folder: Path, config: CaptureConfig) -> None:
    """Noise on the poses of the photographs that later visits may use."""
    rng = np.random.default_rng([config.seed, 23])
    usable = {p.name for p in read_capture(folder).photographs if p.role == "update"}
    path = find_colmap(folder)
    model = read_colmap(path)
    images = dict(model.images)
    for key, image in images.items():
        if image.name in usable:
            turn = Rotation.from_rotvec(np.radians(config.pose_noise) * rng.standard_normal(3) / np.sqrt(3))
            before = Rotation.from_quat(np.asarray(image.quat)[[1, 2, 3, 0]])
            quat = (turn * before).as_quat()[[3, 0, 1, 2]]
            xyz = turn.apply(image.xyz) + 0.01 * config.pose_noise * rng.standard_normal(3) / np.sqrt(3)
            images[key] = dataclasses.replace(image, quat=quat, xyz=xyz)
    write_colmap(path, dataclasses.replace(model, images=images))
