"""What every front end gives: arrays, and nothing about how they were made."""

from typing import Protocol, runtime_checkable

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float, Int

Image = Float[np.ndarray, "h w 3"]


class Dense(eqx.Module):
    """Dense descriptors of one image.

    `features` [h' w' d] float32 with unit norm along the last axis, so that a dot product is a cosine; `stride` px:
    the feature at (i, j) describes the block of stride × stride pixels whose corner is (stride·j, stride·i), and
    h' = ⌈h / stride⌉. `colour_dims` leading dimensions describe colour and do not turn with the image; the rest
    describe structure, which does.
    """

    features: Float[np.ndarray, "hs ws d"]
    stride: int = eqx.field(static=True)
    colour_dims: int = eqx.field(static=True, default=0)


class Correspondences(eqx.Module):
    """Matched positions of two images in pixels (first pixel's centre at (0.5, 0.5)), best first.

    `score` in [0, 1]: the cosine of the two descriptors, or what a model gave as its confidence.
    """

    xy_a: Float[np.ndarray, "m 2"]
    xy_b: Float[np.ndarray, "m 2"]
    score: Float[np.ndarray, " m"]

    def __len__(self) -> int:
        return len(self.xy_a)


class Proposals(eqx.Module):
    """Overlapping regions, stored as unions of the cells of one partition: bytes grow with the cells, not the pixels.

    `leaves` [h w] the cell of every pixel; `members[m, l]` whether region m holds cell l.
    """

    leaves: Int[np.ndarray, "h w"]
    members: Bool[np.ndarray, "m l"]

    def __len__(self) -> int:
        return len(self.members)

    def mask(self, index: int) -> Bool[np.ndarray, "h w"]:
        """One region as a mask."""
        return self.members[index][self.leaves]

    def masks(self) -> Bool[np.ndarray, "m h w"]:
        """All regions as a stack."""
        return self.members[:, self.leaves]

    def areas(self) -> Float[np.ndarray, " m"]:
        """Pixels in each region."""
        return self.sums(np.ones(self.leaves.shape, np.float32))

    def sums(self, image: Float[np.ndarray, "h w"]) -> Float[np.ndarray, " m"]:
        """Sum of a map over each region (of a mask: the intersection), at the cost of one pass over the pixels."""
        cells = np.bincount(self.leaves.ravel(), image.ravel().astype(np.float64), self.members.shape[1])
        return self.members @ cells

    def iou(self, mask: Bool[np.ndarray, "h w"]) -> Float[np.ndarray, " m"]:
        """Intersection over union of each region with a mask; 0 where both are empty."""
        inter = self.sums(mask)
        return inter / np.maximum(self.areas() + mask.sum() - inter, 1)

    def subset(self, index: Int[np.ndarray, " k"] | Bool[np.ndarray, " m"]) -> "Proposals":
        """Some of the regions."""
        return Proposals(self.leaves, self.members[index])


def proposals_from_masks(masks: Bool[np.ndarray, "m h w"]) -> Proposals:
    """Compact form of a stack of (overlapping) masks; raises ValueError when it is not a stack."""
    masks = np.asarray(masks, bool)
    if masks.ndim != 3:
        raise ValueError(f"masks: expected a stack [m h w], got shape {masks.shape}")
    count, height, width = masks.shape
    if count == 0:
        return Proposals(np.zeros((height, width), np.int32), np.zeros((0, 1), bool))
    packed = np.ascontiguousarray(np.packbits(masks.reshape(count, -1), axis=0).T)
    _, first, leaves = np.unique(packed.view(f"V{packed.shape[1]}").ravel(), return_index=True, return_inverse=True)
    return Proposals(leaves.reshape(height, width).astype(np.int32), masks.reshape(count, -1)[:, first])


@runtime_checkable
class FrontEnd(Protocol):
    """The three roles of the paper's foundation models, for images [h w 3] float32 in [0, 1].

    All of it is deterministic; `fingerprint` names the method and its options, and changes whenever an answer may.
    """

    def fingerprint(self) -> str:
        """What keys the cache, with the image's bytes."""
        ...

    def describe(self, image: Image) -> Dense:
        """Dense descriptors (the paper's semantic features)."""
        ...

    def propose(self, image: Image, *, guide: Float[np.ndarray, "h w"] | None = None) -> Proposals:
        """Class-agnostic regions (the paper's SAM); `guide` in [0, 1] marks where the caller looks for an object."""
        ...

    def keypoints(self, image: Image) -> tuple[Float[np.ndarray, "m 2"], Float[np.ndarray, "m d"]]:
        """Sparse positions in pixels and unit descriptors."""
        ...

    def match(
        self,
        image_a: Image,
        image_b: Image,
        *,
        mask_a: Bool[np.ndarray, "ha wa"] | None = None,
        mask_b: Bool[np.ndarray, "hb wb"] | None = None,
        fundamental: Float[np.ndarray, "3 3"] | None = None,
    ) -> Correspondences:
        """Reciprocal correspondences (the paper's MASt3R), inside the masks and near x_bᵀ·F·x_a = 0 where given."""
        ...


def check_image(image: np.ndarray, *, name: str = "image") -> Image:
    """The image as contiguous float32; raises ValueError unless it is [h w 3] and finite."""
    image = np.ascontiguousarray(image, dtype=np.float32)
    if image.ndim != 3 or image.shape[2] != 3 or 0 in image.shape:
        raise ValueError(f"{name}: expected [h w 3] with values in [0, 1], got shape {image.shape}")
    if not np.isfinite(image).all():
        raise ValueError(f"{name}: expected finite values, got {np.sum(~np.isfinite(image))} that are not")
    return image
