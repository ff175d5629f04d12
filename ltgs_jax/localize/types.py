"""Options and answers of localisation."""

import dataclasses

from ltgs_jax.geometry import Camera
from ltgs_jax.io import CameraModel, Capture


@dataclasses.dataclass(frozen=True)
class LocalizeConfig:
    """How photographs without a pose are placed.

    `refine_given` places the later photographs again even where the capture gives their pose; `first_visit` also
    places the unposed photographs of the first visit. `max_side` px of the photographs while matching (every pixel
    threshold counts at this size); `contrast` SIFT's threshold; `tilts` of the simulated views (ASIFT) for those that
    plain SIFT cannot place; `max_ratio` Lowe's; `min_cosine` of descriptors. Gate: `min_inliers`, `min_ratio` (share
    of agreeing matches in the best view of the map), `max_extent` (distance from the cameras' middle in extents of
    the cameras). Retrieval: above `max_views` known photographs, each other one is matched with the `retrieved` most
    alike. `focal_factors`: focal lengths to try, in that of the lens of a like photograph, where no file gives one.
    """

    refine_given: bool = False
    first_visit: bool = True
    max_side: int = 960
    contrast: float = 0.002
    tilts: tuple[float, ...] = (1.5, 2.2)
    max_ratio: float = 0.85
    min_cosine: float = 0.7
    min_inliers: int = 20
    min_ratio: float = 0.05
    max_extent: float = 10.0
    max_views: int = 200
    retrieved: int = 20
    focal_factors: tuple[float, ...] = (0.7, 0.84, 1.0, 1.2, 1.44)
    seed: int = 0


@dataclasses.dataclass(frozen=True)
class PhotographStatus:
    """What became of one photograph: `status` is given, localized or rejected (with the `reason`).

    `inliers` the points that agree with the pose (of a given one: the sparse points that it sees, None without a
    model); `residual` their median distance in pixels of the stored photograph, None where it was not measured.
    """

    name: str
    status: str
    inliers: int | None
    residual: float | None
    reason: str | None


@dataclasses.dataclass(frozen=True)
class Localization:
    """Cameras of every photograph that has one, given or found, with its lens; and the status of each photograph."""

    cameras: dict[str, Camera]
    lenses: dict[str, CameraModel]
    photographs: tuple[PhotographStatus, ...]

    def without(self, reasons: dict[str, str]) -> "Localization":
        """The same without the cameras of some photographs, rejected for the reason given by name."""
        return Localization(
            {name: camera for name, camera in self.cameras.items() if name not in reasons},
            {name: lens for name, lens in self.lenses.items() if name not in reasons},
            tuple(
                dataclasses.replace(p, status="rejected", reason=reasons[p.name]) if p.name in reasons else p
                for p in self.photographs
            ),
        )

    def apply(self, capture: Capture) -> Capture:
        """The capture with the cameras that were found; given ones are the same objects as before."""
        photographs = tuple(
            dataclasses.replace(p, camera=self.cameras[p.name], camera_model=self.lenses[p.name])
            if p.name in self.lenses
            else p
            for p in capture.photographs
        )
        return dataclasses.replace(capture, photographs=photographs)
