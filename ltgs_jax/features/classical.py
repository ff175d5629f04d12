"""The front end that needs no download: OpenCV alone."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from .dense import dense_descriptors
from .keypoints import inside, match_descriptors, root_sift
from .proposals import segment_proposals
from .protocol import Correspondences, Dense, Image, Proposals


@dataclass(frozen=True)
class Classical:
    """Colour and gradient descriptors, graph-segmentation proposals, RootSIFT matches; one setting for every scene.

    `stride` px of the dense descriptors; `colour_weight` share of colour in their cosine; `work_size` px of the longer
    side while segmenting; `min_area` of a proposal as a share of the image; `contrast` SIFT's threshold; `max_ratio`
    Lowe's ratio; `epipolar_px` how far from the epipolar line a match may lie.
    """

    stride: int = 2
    colour_weight: float = 0.5
    work_size: int = 400
    min_area: float = 4e-4
    contrast: float = 0.004
    max_ratio: float = 0.85
    epipolar_px: float = 3.0

    def fingerprint(self) -> str:
        """The options, and a number to raise when the method changes."""
        return f"classical-1 {self}"

    def describe(self, image: Image) -> Dense:
        """See `dense_descriptors`."""
        return dense_descriptors(image, stride=self.stride, colour_weight=self.colour_weight)

    def propose(self, image: Image, *, guide: Float[np.ndarray, "h w"] | None = None) -> Proposals:
        """See `segment_proposals`."""
        return segment_proposals(image, guide=guide, work_size=self.work_size, min_area=self.min_area)

    def keypoints(self, image: Image) -> tuple[Float[np.ndarray, "m 2"], Float[np.ndarray, "m d"]]:
        """See `root_sift`."""
        return root_sift(image, contrast=self.contrast)

    def match(
        self,
        image_a: Image,
        image_b: Image,
        *,
        mask_a: Bool[np.ndarray, "ha wa"] | None = None,
        mask_b: Bool[np.ndarray, "hb wb"] | None = None,
        fundamental: Float[np.ndarray, "3 3"] | None = None,
    ) -> Correspondences:
        """See `match_descriptors`; masks select keypoints before they compete."""
        (xy_a, desc_a), (xy_b, desc_b) = self.keypoints(image_a), self.keypoints(image_b)
        in_a, in_b = inside(xy_a, mask_a), inside(xy_b, mask_b)
        return match_descriptors(
            (xy_a[in_a], desc_a[in_a]),
            (xy_b[in_b], desc_b[in_b]),
            fundamental=fundamental,
            max_ratio=self.max_ratio,
            epipolar_px=self.epipolar_px,
        )
