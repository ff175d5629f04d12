"""A front end whose answers the user computed elsewhere."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float

from .cache import content_hash
from .classical import Classical
from .keypoints import inside, match_descriptors
from .protocol import Correspondences, Dense, FrontEnd, Image, Proposals, check_image, proposals_from_masks

_MOST_BYTES = 400 << 20  # of one photograph's arrays, unpacked: a hundred masks of 2000×2000; zeros pack a thousandfold


def name_images(images: Iterable[tuple[str, Image]]) -> tuple[tuple[str, str], ...]:
    """(content hash, name) of images, by which `FromDisk` knows whose arrays to read; the name is `<visit>/<file>`."""
    return tuple((content_hash(check_image(image)), name) for name, image in images)


@dataclass(frozen=True)
class FromDisk:
    """Arrays from `<folder>/<name>.npz`, for the photographs that `names` lists; any of:

    `features` [h' w' d] and `stride` px; `masks` [m h w] or `labels` [h w] (0 = no region), at any size, they are
    scaled to the image; `xy` [m 2] px (corner at 0) with `descriptors` [m d]. What a file lacks, and images that are
    not listed, are left to `otherwise`; but descriptors are compared between images, so that where some come from
    disk all must: `describe` of an image without them raises ValueError.
    """

    folder: Path
    names: tuple[tuple[str, str], ...]
    otherwise: FrontEnd = field(default_factory=Classical)
    max_ratio: float = 0.9

    def fingerprint(self) -> str:
        """The files' names, sizes and times of change, and the front end that fills the gaps."""
        stats = [(name, path.stat()) for _, name in self.names if (path := self._path(name)).is_file()]
        files = sorted((name, stat.st_size, stat.st_mtime_ns) for name, stat in stats)
        return f"disk-1 {content_hash(repr(files))} {self.max_ratio} {self.otherwise.fingerprint()}"

    def describe(self, image: Image) -> Dense:
        """The file's `features`, scaled to unit norm. Raises ValueError where other images have some and this none."""
        arrays = self._arrays(image)
        if "features" in arrays:
            features = np.asarray(arrays["features"], np.float32)
            norm = np.linalg.norm(features, axis=-1, keepdims=True)
            return Dense(features / np.maximum(norm, 1e-12), int(arrays.get("stride", 1)))
        if any("features" in self._read(name) for _, name in self.names):
            raise ValueError(f"{self.folder}: has descriptors of some images but not of this one; they cannot be mixed")
        return self.otherwise.describe(image)

    def propose(self, image: Image, *, guide: Float[np.ndarray, "h w"] | None = None) -> Proposals:
        """The file's `masks` or `labels`; the guide is for front ends that look for themselves."""
        arrays = self._arrays(image)
        if "masks" in arrays:
            masks = np.asarray(arrays["masks"], bool)
        elif "labels" in arrays:
            labels = np.asarray(arrays["labels"])
            masks = labels[None] == np.unique(labels[labels != 0])[:, None, None]
        else:
            return self.otherwise.propose(image, guide=guide)
        size = (image.shape[1], image.shape[0])
        scaled = [cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST_EXACT) > 0 for mask in masks]
        return proposals_from_masks(np.stack(scaled) if scaled else np.zeros((0, *image.shape[:2]), bool))

    def keypoints(self, image: Image) -> tuple[Float[np.ndarray, "m 2"], Float[np.ndarray, "m d"]]:
        """The file's `xy` and `descriptors`, the latter scaled to unit norm."""
        arrays = self._arrays(image)
        if "xy" not in arrays or "descriptors" not in arrays:
            return self.otherwise.keypoints(image)
        descriptors = np.asarray(arrays["descriptors"], np.float32)
        norm = np.linalg.norm(descriptors, axis=-1, keepdims=True)
        return np.asarray(arrays["xy"], np.float32), descriptors / np.maximum(norm, 1e-12)

    def match(
        self,
        image_a: Image,
        image_b: Image,
        *,
        mask_a: Bool[np.ndarray, "ha wa"] | None = None,
        mask_b: Bool[np.ndarray, "hb wb"] | None = None,
        fundamental: Float[np.ndarray, "3 3"] | None = None,
    ) -> Correspondences:
        """Reciprocal matches where both files bring keypoints, else what `otherwise` finds."""
        if not all("xy" in self._arrays(image) for image in (image_a, image_b)):
            masks = {"mask_a": mask_a, "mask_b": mask_b}
            return self.otherwise.match(image_a, image_b, **masks, fundamental=fundamental)
        chosen = []
        for image, mask in ((image_a, mask_a), (image_b, mask_b)):
            xy, descriptors = self.keypoints(image)
            free = inside(xy, mask)
            chosen.append((xy[free], descriptors[free]))
        return match_descriptors(*chosen, fundamental=fundamental, max_ratio=self.max_ratio)

    def _path(self, name: str) -> Path:
        return Path(self.folder) / f"{name}.npz"

    def _read(self, name: str) -> dict[str, np.ndarray]:
        """All arrays of a file; empty when it is missing. Raises ValueError naming one that cannot be read."""
        path = self._path(name)
        if not path.is_file():
            return {}
        try:
            with path.open("rb") as handle, np.load(handle) as file:
                if sum(entry.file_size for entry in file.zip.infolist()) > _MOST_BYTES:
                    raise ValueError(f"unpacked it has more than {_MOST_BYTES >> 20} MiB")
                return {key: file[key] for key in file.files}
        except Exception as error:
            why = " ".join(str(error).split())
            raise ValueError(f"{path}: cannot be read as npz without pickle ({why:.200})") from None

    def _arrays(self, image: Image) -> dict[str, np.ndarray]:
        name = dict(self.names).get(content_hash(check_image(image)))
        return {} if name is None else self._read(name)
