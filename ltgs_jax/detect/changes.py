"""Where a photograph differs from the render by more than the scene's own error lets expect."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage
from skimage.filters import threshold_otsu

from ltgs_jax.features import FrontEnd

from .similarity import similarity

_LEAST_EXPECTED = 0.02  # dissimilarity of two photographs of one thing: noise and resampling
_LEAST_GRADIENT = 0.01  # per pixel, in 0…1: what noise makes of a flat surface
_UNLIKE = 0.2  # dissimilarity above the expected one that no noise or blur of a fit leaves over wide areas
_EVERYWHERE = 0.55  # share of it where there is detail, from which on the photograph is of or from somewhere else
_WIDE = 0.4  # least share of it in the whole picture then: the only detail of a plain wall may be what changed
_COLOURLESS = 0.15  # share of a region below which the colours do not tell its outline


@dataclass(frozen=True)
class DetectConfig:
    """One setting for every scene."""

    gamma: float = 0.7
    """γ, the share of semantic cosine against SSIM."""
    sigmas: float = 5.0
    """A difference counts from this many robust standard deviations of the unchanged pixels on."""
    alone: float = 10.0
    """Mean score, in the same deviations, of something that only one photograph shows."""
    min_area: float = 4e-4
    """Smallest region, as a share of the image."""
    dilate: int = 3
    """Pixels by which masks are dilated before they are used as outlines."""
    guessed: float = 0.3
    """Dissimilarity to be expected where the scene's colours are guesses, under something that left."""
    moved: float = 0.1
    """Least dissimilarity to be expected of an object away from its first place: other light, sides seldom seen."""
    unexplained: float = 0.4
    """Expected dissimilarity from which on the initial scene says nothing: no photograph showed it well enough."""


class ChangeMap(eqx.Module):
    """What one photograph says of change.

    `score` in robust standard deviations above expectation; `left` where the render shows what the photograph does not,
    −1…1: −1 where the pixel is as expected, 1 where something left, 0 where it cannot be told; `mask` the pixels that
    changed, whichever way; `two_classes` whether there is a class of changed pixels at all (False: the mask is empty);
    `everywhere` whether most of the picture differs: then it tells nothing of single objects, and the rest is empty.
    """

    score: Float[np.ndarray, "h w"]
    left: Float[np.ndarray, "h w"]
    mask: Bool[np.ndarray, "h w"]
    two_classes: bool
    everywhere: bool = False


def change_map(
    rendered: Float[np.ndarray, "h w 3"],
    captured: Float[np.ndarray, "h w 3"],
    expected: Float[np.ndarray, "h w"],
    valid: Bool[np.ndarray, "h w"],
    front_end: FrontEnd,
    *,
    config: DetectConfig = DetectConfig(),
) -> ChangeMap:
    """Change mask of one photograph.

    1 − similarity, less what the scene's own fit lets `expected`, in units of the deviation that unchanged pixels of
    the same expectation show; binarised by Otsu, but never below `config.sigmas`, and only where the part above is a
    class of its own. In both directions, each with a deviation of its own: what left has its detail in the render, and
    that alone is proof; what came has it in the photograph, as has all that the scene never knew well.
    Descriptors reach several pixels beyond what changed: the outline is that of the colours.
    Where most detail is unlike what it should be, level and deviation are those of the change itself: the map is
    empty, and says so.
    """
    # Descriptors and windows reach across the border of what counts; beyond it nothing may differ.
    captured = np.where(valid[..., None], captured, rendered)
    known = valid & (expected < config.unexplained)
    nothing = np.zeros_like(expected, dtype=np.float32)
    if known.sum() < 64:
        return ChangeMap(nothing, nothing, np.zeros_like(valid), False)
    excess = 1 - similarity(rendered, captured, front_end, gamma=config.gamma) - expected
    balance, detailed = _detail_balance(rendered, captured)
    unlike, detailed = known & (excess > _UNLIKE), known & detailed
    if unlike.sum() > _WIDE * known.sum() and (unlike & detailed).sum() > _EVERYWHERE * detailed.sum():
        return ChangeMap(nothing, nothing, np.zeros_like(valid), False, everywhere=True)
    scores, masks, thresholds = [], [], []
    alike = _equally_expected(expected[known])
    colours = colour_difference(rendered, captured)
    colours = _standardize(colours, expected, known, alike, floor=0.005) > config.sigmas
    for weight in (np.clip(0.5 + balance, 0, 1.25), np.clip(1 - balance, 0, 1)):
        score = _standardize(excess * weight, expected, known, alike, floor=0.01)
        clipped = np.clip(score[known], 0, 4 * config.sigmas)
        threshold = max(float(threshold_otsu(clipped)), config.sigmas) if np.ptp(clipped) > 0 else config.sigmas
        coarse = clean(known & (score > threshold), config.min_area)
        scores.append(score / threshold)
        masks.append((coarse, _sharpen(coarse, known & colours, config)))
        thresholds.append(threshold)
    (coarse_left, left), (coarse_came, came) = masks
    plain = np.maximum(*scores)
    mask = left | came
    # Where both have detail, one thing took another's place.
    replaced = left | (came & (balance > -0.3))
    evidence = np.where(known & ~coarse_left & ~coarse_came, np.clip(2 * plain, 0, 1) - 1, replaced.astype(np.float32))
    return ChangeMap(plain * max(thresholds), evidence.astype(np.float32), mask, bool(mask.any()))


def _detail_balance(
    rendered: Float[np.ndarray, "h w 3"], captured: Float[np.ndarray, "h w 3"]
) -> tuple[Float[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
    """Whose gradients are stronger around each pixel: 1 the render's alone, −1 the photograph's alone; and where they
    are more than noise."""

    def energy(image):
        grey = cv2.GaussianBlur(image.mean(axis=-1).astype(np.float32), (0, 0), 1.0)
        gx, gy = cv2.Sobel(grey, cv2.CV_32F, 1, 0, scale=0.125), cv2.Sobel(grey, cv2.CV_32F, 0, 1, scale=0.125)
        return cv2.GaussianBlur(gx * gx + gy * gy, (0, 0), max(image.shape[:2]) / 100)

    a, b = energy(rendered), energy(captured)
    return (a - b) / (a + b + _LEAST_GRADIENT**2), a + b > _LEAST_GRADIENT**2


def _equally_expected(expected: Float[np.ndarray, " n"]) -> list[Int[np.ndarray, " m"]]:
    """Pixels in bins of about equal expectation."""
    order = np.argsort(expected, kind="stable")
    return np.array_split(order, int(np.clip(len(order) // 400, 1, 12)))


def _standardize(
    value: Float[np.ndarray, "h w"],
    expected: Float[np.ndarray, "h w"],
    known: Bool[np.ndarray, "h w"],
    bins: Sequence[Int[np.ndarray, " m"]],
    *,
    floor: float,
) -> Float[np.ndarray, "h w"]:
    """`value` in robust deviations above its usual level, 0 where not `known`.

    Level and deviation grow in proportion to `expected`: what the scene explains badly differs more, and differs more
    widely. The two factors are medians over `bins` of equal expectation, so that neither a large change nor a large
    blurred background decides them alone.
    """
    scale = expected + _LEAST_EXPECTED
    ratio = (value / scale)[known]
    level = np.median([np.median(ratio[b]) for b in bins])
    spread = np.median([1.4826 * np.median(np.abs(ratio[b] - level)) for b in bins])
    return np.where(known, (value - level * scale) / (spread * scale + floor), 0).astype(np.float32)


def colour_difference(
    rendered: Float[np.ndarray, "h w 3"], captured: Float[np.ndarray, "h w 3"]
) -> Float[np.ndarray, "h w"]:
    """Mean absolute difference of the colours, the smallest over shifts of the render by up to a pixel."""
    captured = cv2.GaussianBlur(captured, (0, 0), 0.7)
    padded = cv2.copyMakeBorder(cv2.GaussianBlur(rendered, (0, 0), 0.7), 1, 1, 1, 1, cv2.BORDER_REPLICATE)
    h, w = captured.shape[:2]
    shifted = [np.abs(padded[y : y + h, x : x + w] - captured).mean(axis=-1) for y in range(3) for x in range(3)]
    return np.min(shifted, axis=0)


def _sharpen(
    coarse: Bool[np.ndarray, "h w"], fine: Bool[np.ndarray, "h w"], config: DetectConfig
) -> Bool[np.ndarray, "h w"]:
    """Each coarse region cut to where colours differ too, closed and filled; whole where they hardly do (texture)."""
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (7, 7))
    closed = cv2.morphologyEx((fine & coarse).astype(np.uint8), cv2.MORPH_CLOSE, kernel) > 0
    closed = clean(ndimage.binary_fill_holes(closed) & coarse, config.min_area)
    labels, count = ndimage.label(coarse, np.ones((3, 3)))
    area = np.bincount(labels.ravel(), minlength=count + 1)
    share = np.bincount(labels.ravel(), closed.ravel(), minlength=count + 1) / np.maximum(area, 1)
    return np.where((share > _COLOURLESS)[labels], closed, coarse)


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
