"""What later photographs show that was hardly shown at the first visit, and where they show what nobody explained."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from ltgs_jax.detect import colour_difference, dilate
from ltgs_jax.fit import View, VisitView
from ltgs_jax.scene import Chronology

from .ledger import small_views
from .looks import Eye
from .state import composed

_TIMES = 0.5  # of what later photographs show of a splat, up to which the first visit's together hardly showed it
_TELLS = 160  # pixels along the longer side of a photograph that tell how much of a splat it shows
_MOSTLY = 0.5  # share of a pixel's colour that splats must give for it to be theirs
_ROBUST = 1.4826  # deviation of a normal distribution over its median absolute one


def barely_shown(
    chronology: Chronology, first: Sequence[VisitView], later: Sequence[VisitView], eye: Eye
) -> tuple[Bool[np.ndarray, " n"], float]:
    """Which of the background's splats that were there at the first visit all its photographs together show less than
    half as much of as those of later visits do (Σ αT over pixels that count); and their share of what these show."""
    before, after = _shown(chronology, first, eye), _shown(chronology, later, eye)
    if chronology.since is not None:
        after = after * (np.asarray(chronology.since) == 0)
    barely = before < _TIMES * after
    return barely, float(after[barely].sum() / max(after.sum(), 1e-12))


def _shown(chronology: Chronology, views: Sequence[VisitView], eye: Eye) -> Float[np.ndarray, " n"]:
    """What photographs, made small, show of each of the background's splats."""
    total, scenes = np.zeros(chronology.background.count), {}
    for v in small_views(views, _TELLS):
        if v.visit not in scenes:
            scenes[v.visit] = composed(chronology, v.visit)
        mask = np.asarray(v.view.mask, np.float32)[..., None]
        total += eye.votes(scenes[v.visit], v.view.camera, mask)[: len(total), 0]
    return total


def without_unexplained(
    chronology: Chronology, barely: Bool[np.ndarray, " n"], views: Sequence[VisitView], eye: Eye, *, sigmas: float
) -> list[VisitView]:
    """Photographs of later visits less the pixels in which they show something else than what the first visit showed
    well: a change that no account explains, which is none of the background's. Colours differ from `sigmas` robust
    deviations on."""
    kept = []
    for v in views:
        scene, view = composed(chronology, v.visit), v.view
        doubt = np.pad(barely.astype(np.float32), (0, scene.count - len(barely)))
        look = eye.look(scene, view.camera, doubt)
        known = view.mask & (look.alpha > _MOSTLY) & (look.expected < _MOSTLY)
        difference = colour_difference(look.image, np.asarray(view.image, np.float32) / 255)
        usual = np.median(difference[known]) if known.any() else 0.0
        spread = _ROBUST * np.median(np.abs(difference[known] - usual)) if known.any() else 0.0
        other = dilate(known & (difference > usual + sigmas * spread), 1)
        kept.append(VisitView(View(view.camera, view.image, view.mask & ~other), v.visit))
    return kept
