"""Shadows and bared ground told from things: they lie flat, and have the colour of the ground around."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from ltgs_jax.geometry import C0
from ltgs_jax.scene import Splats
from ltgs_jax.template import Support

_FLAT = 0.3  # height over width up to which something may be the ground itself
_TINT = 0.05  # difference of chromaticity up to which it is: shadows keep the colour of what they fall on
_SHADED = (0.4, 1.05)  # brightness of a shadow over that of the ground around
_LIT = 0.55  # by which ground may be brighter than that, where the shadow of something that left may have lain
_ENOUGH = 30  # pixels of a photograph that tell whether only light changed there
_ALL_ALIKE = (0.08, 0.2)  # log ratio of its colours to those before: channels apart, and pixels apart, where it did
_DARK = 0.05  # floor of ratios of colours
_FEW = 8  # splats with fewer of which nothing is told
_OPAQUE = 0.3


def ground_shade(
    splats: Splats, support: Support, background: Splats, *, bared: float = 0.0, unshaded: bool = False
) -> tuple[bool | None, float]:
    """Whether splats are the ground itself, and their brightness over that of the ground around them.

    `support` the surface below, `background` everything else that is known, `bared` the share of what they show that
    something else had hidden before: the more, the more tint and brightness may differ. `unshaded`: something left
    close by, and may have taken a shadow along. None, 1 where too little is known to tell.
    """
    means = np.asarray(splats.means, np.float64)
    around = None if splats.count < _FEW else _color_around(means, support, background)
    if around is None:
        return None, 1.0
    width = np.linalg.norm(np.ptp(means @ support.frame()[:2].T, axis=0))
    colors = _colors(splats)
    tint = np.median(np.abs(_chromaticity(colors) - _chromaticity(around)).max(axis=-1))
    shade = float(np.median(colors.sum(axis=-1)) / max(around.sum(), 0.05))
    flat = np.median(support.height(means)) <= _FLAT * width
    shaded = _SHADED[0] * (1 - bared) < shade < _SHADED[1] + max(bared, _LIT * unshaded)
    return bool(flat and shaded and tint < _TINT * (1 + bared)), shade


def light_alone(
    images: Sequence[Float[np.ndarray, "h w 3"]],
    before: Sequence[Float[np.ndarray, "h w 3"]],
    changed: Sequence[Bool[np.ndarray, "h w"]],
) -> float | None:
    """The gain that explains a change in all photographs that show enough of it, if one for all channels and pixels of
    each does: a shadow came or left, and nothing else. A thing has edges, a print and a tint of its own.
    """
    gains, counts = [], []
    for image, known, mask in zip(images, before, changed, strict=True):
        if mask.sum() < _ENOUGH:
            continue
        ratio = np.log((image[mask] + _DARK) / (known[mask] + _DARK))
        grey = ratio.mean(axis=-1)
        tint = np.median(np.abs(ratio - grey[:, None]).max(axis=-1))
        spread = 1.4826 * np.median(np.abs(grey - np.median(grey)))
        if tint > _ALL_ALIKE[0] or spread > _ALL_ALIKE[1]:
            return None
        gains.append(np.median(grey))
        counts.append(mask.sum())
    return float(np.exp(np.average(gains, weights=counts))) if gains else None


def _color_around(
    means: Float[np.ndarray, "n 3"], support: Support, background: Splats
) -> Float[np.ndarray, "3"] | None:
    """Median colour of the background's splats on a support around some points, or None where there are few."""
    ground, size = np.asarray(background.means, np.float64), np.linalg.norm(np.ptp(means, axis=0))
    near = np.linalg.norm(ground - np.median(means, axis=0), axis=1) < 1.2 * size
    near &= np.abs(support.height(ground)) < 4 * support.noise + 0.02 * size
    near &= np.asarray(background.opacities) > _OPAQUE
    return np.median(_colors(background)[near], axis=0) if near.sum() >= _FEW else None


def _colors(splats: Splats) -> Float[np.ndarray, "n 3"]:
    return np.clip(np.asarray(splats.sh[:, 0]) * C0 + 0.5, 0, 1)


def _chromaticity(colors: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
    return colors / np.maximum(colors.sum(axis=-1, keepdims=True), 0.05)
