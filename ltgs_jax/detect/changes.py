"""Where a photograph differs from the render by more than the scene's own error lets expect."""

from dataclasses import dataclass

import cv2
import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage
from skimage.filters import threshold_otsu

from ltgs_jax.features import FrontEnd

from .similarity import similarity


@dataclass(frozen=True)
class DetectConfig:
    """One setting for every scene."""

    gamma: float = 0.7
    """γ, the share of semantic cosine against SSIM."""
    sigmas: float = 5.0
    """A difference counts from this many robust standard deviations of the unchanged pixels on."""
    min_area: float = 4e-4
    """Smallest region, as a share of the image."""
    dilate: int = 3
    """Pixels by which masks are dilated before they are used as outlines."""
    guessed: float = 0.3
    """Dissimilarity to be expected where the scene's colours are guesses, under something that left."""
    unexplained: float = 0.4
    """Expected dissimilarity from which on the initial scene says nothing: no photograph showed it well enough."""


class ChangeMap(eqx.Module):
    """`score` in robust standard deviations above expectation; `mask` the pixels past the threshold; the threshold;
    `two_classes` whether Otsu's split is one (False: the mask is empty, nothing changed)."""

    score: Float[np.ndarray, "h w"]
    mask: Bool[np.ndarray, "h w"]
    threshold: float
    two_classes: bool


def change_map(
    rendered: Float[np.ndarray, "h w 3"],
    captured: Float[np.ndarray, "h w 3"],
    expected: Float[np.ndarray, "h w"],
    valid: Bool[np.ndarray, "h w"],
    front_end: FrontEnd,
    *,
    config: DetectConfig = DetectConfig(),
) -> ChangeMap:
    """Coarse change mask of one photograph.

    1 − similarity, less what the scene's own fit lets `expected`, in units of the unchanged pixels' robust deviation;
    binarised by Otsu, but never below `config.sigmas`, and only where the part above is a class of its own.
    """
    # Descriptors and windows reach across the border of what counts; beyond it nothing may differ.
    captured = np.where(valid[..., None], captured, rendered)
    difference = 1 - similarity(rendered, captured, front_end, gamma=config.gamma)
    excess = difference - expected
    known = valid & (expected < config.unexplained)
    inside = excess[known]
    if len(inside) < 64:
        return ChangeMap(np.zeros_like(excess), np.zeros_like(valid), np.inf, False)
    middle = np.median(inside)
    deviation = 1.4826 * np.median(np.abs(inside - middle)) + 0.01
    score = np.where(known, (excess - middle) / deviation, 0).astype(np.float32)
    clipped = np.clip(score[known], 0, 4 * config.sigmas)
    threshold = max(float(threshold_otsu(clipped)), config.sigmas) if np.ptp(clipped) > 0 else config.sigmas
    mask = known & (score > threshold)
    mask = clean(mask, config.min_area)
    two_classes = bool(mask.any())
    return ChangeMap(score, mask, threshold, two_classes)


def clean(mask: Bool[np.ndarray, "h w"], min_area: float) -> Bool[np.ndarray, "h w"]:
    """Close small gaps, fill holes, and leave out regions smaller than `min_area` of the image."""
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (5, 5))
    closed = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_CLOSE, kernel)
    closed = ndimage.binary_fill_holes(closed).astype(np.uint8)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(closed, connectivity=8)
    keep = stats[:, cv2.CC_STAT_AREA] >= max(9, min_area * mask.size)
    keep[0] = False
    return keep[labels] if count > 1 else np.zeros_like(mask)


def dilate(mask: Bool[np.ndarray, "h w"], pixels: int) -> Bool[np.ndarray, "h w"]:
    """The mask grown by a disc."""
    if pixels <= 0:
        return mask
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * pixels + 1, 2 * pixels + 1))
    return cv2.dilate(mask.astype(np.uint8), kernel).astype(bool)
