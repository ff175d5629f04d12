"""SIFT keypoints with RootSIFT descriptors (Arandjelović & Zisserman 2012) and their reciprocal matching."""

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int

from .protocol import Correspondences, Image, check_image


def root_sift(
    image: Image, *, contrast: float = 0.004, max_keypoints: int = 8000
) -> tuple[Float[np.ndarray, "m 2"], Float[np.ndarray, "m 128"]]:
    """Positions in pixels (+0.5, as COLMAP) and unit RootSIFT descriptors, in the detector's order.

    `contrast` is SIFT's threshold on the difference of Gaussians, in [0, 1] grey.
    """
    grey = cv2.cvtColor(np.uint8(np.round(255 * np.clip(check_image(image), 0, 1))), cv2.COLOR_RGB2GRAY)
    sift = cv2.SIFT_create(nfeatures=max_keypoints, contrastThreshold=3 * contrast, enable_precise_upscale=True)
    points, descriptors = sift.detectAndCompute(grey, None)
    if not points:
        return np.zeros((0, 2), np.float32), np.zeros((0, 128), np.float32)
    xy = np.array([point.pt for point in points], np.float32) + np.float32(0.5)
    root = np.sqrt(descriptors / np.maximum(descriptors.sum(axis=1, keepdims=True), 1))
    return xy, root.astype(np.float32)


def inside(xy: Float[np.ndarray, "m 2"], mask: Bool[np.ndarray, "h w"] | None) -> Bool[np.ndarray, " m"]:
    """Whether each position lies on a true pixel of the mask (everywhere without one)."""
    if mask is None:
        return np.ones(len(xy), bool)
    x = np.clip(np.floor(xy[:, 0]).astype(int), 0, mask.shape[1] - 1)
    y = np.clip(np.floor(xy[:, 1]).astype(int), 0, mask.shape[0] - 1)
    return np.asarray(mask, bool)[y, x]


def epipolar_distances(
    xy_a: Float[np.ndarray, "m 2"], xy_b: Float[np.ndarray, "n 2"], fundamental: Float[np.ndarray, "3 3"]
) -> Float[np.ndarray, "m n"]:
    """Distance in pixels of every b from the epipolar line of every a, x_bᵀ·F·x_a = 0."""
    lines = np.concatenate([xy_a, np.ones_like(xy_a[:, :1])], axis=1) @ np.asarray(fundamental, np.float64).T
    lines /= np.maximum(np.linalg.norm(lines[:, :2], axis=1, keepdims=True), 1e-12)
    # Normalised in float64, then float32 is good to 1e-3 px and twice as fast.
    lines = lines.astype(np.float32)
    distances = lines[:, :2] @ np.asarray(xy_b, np.float32).T
    distances += lines[:, 2:]
    return np.abs(distances, out=distances)


def _best_elsewhere(
    cosine: Float[np.ndarray, "k n"], own: Int[np.ndarray, " k"], xy: Float[np.ndarray, "n 2"]
) -> Float[np.ndarray, " k"]:
    """The best cosine of each row at another place than its own match, -1 where there is none.

    SIFT repeats a keypoint for each of its orientations, hence not simply the second best; nor more than five times.
    """
    count = min(6, cosine.shape[1])
    top = np.argpartition(-cosine, count - 1, axis=1)[:, :count]
    same_place = np.linalg.norm(xy[top] - xy[own][:, None], axis=-1) < 1.5
    return np.max(np.where(same_place, -1, np.take_along_axis(cosine, top, axis=1)), axis=1, initial=-1)


def match_indices(
    a: tuple[Float[np.ndarray, "m 2"], Float[np.ndarray, "m d"]],
    b: tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n d"]],
    *,
    fundamental: Float[np.ndarray, "3 3"] | None = None,
    max_ratio: float = 0.85,
    min_cosine: float = 0.6,
    epipolar_px: float = 3.0,
) -> tuple[Int[np.ndarray, " k"], Int[np.ndarray, " k"], Float[np.ndarray, " k"]]:
    """Mutual nearest neighbours that pass Lowe's ratio test in both directions: indices and cosines, best first.

    Args: positions and unit descriptors of the two images; `fundamental` restricts the candidates (and the runner-up
    of the ratio test) to `epipolar_px` pixels about the epipolar line. `max_ratio` compares Euclidean distances.
    """
    (xy_a, desc_a), (xy_b, desc_b) = a, b
    if len(xy_a) == 0 or len(xy_b) == 0:
        return np.zeros(0, int), np.zeros(0, int), np.zeros(0, np.float32)
    cosine = desc_a @ desc_b.T
    if fundamental is not None:
        cosine[epipolar_distances(xy_a, xy_b, fundamental) > epipolar_px] = -1
    best = np.argmax(cosine, axis=1)
    rows = np.arange(len(xy_a))
    score = cosine[rows, best]
    keep = (np.argmax(cosine, axis=0)[best] == rows) & (score >= min_cosine)
    rows, best, score = rows[keep], best[keep], score[keep]
    passed = np.ones(len(rows), bool)
    for rivals, own, xy in ((cosine[rows], best, xy_b), (cosine[:, best].T, rows, xy_a)):
        runner_up = _best_elsewhere(rivals, own, xy)
        passed &= np.sqrt(np.maximum(1 - score, 0)) <= max_ratio * np.sqrt(np.maximum(1 - runner_up, 0))
    rows, best, score = rows[passed], best[passed], score[passed]
    order = np.argsort(-score, kind="stable")
    rows, best = rows[order], best[order]
    _, first = np.unique(np.concatenate([xy_a[rows], xy_b[best]], axis=1), axis=0, return_index=True)
    first.sort()
    return rows[first], best[first], np.clip(score[order][first], 0, 1)


def match_descriptors(
    a: tuple[Float[np.ndarray, "m 2"], Float[np.ndarray, "m d"]],
    b: tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n d"]],
    **options,
) -> Correspondences:
    """`match_indices` as positions; the same options."""
    rows, columns, score = match_indices(a, b, **options)
    return Correspondences(a[0][rows], b[0][columns], score)
