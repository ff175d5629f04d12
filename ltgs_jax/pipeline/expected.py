"""How much the scene must be expected to differ from a photograph where nothing changed."""

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float

from ltgs_jax.detect import similarity
from ltgs_jax.features import FrontEnd
from ltgs_jax.fit import StreamedView, View
from ltgs_jax.scene import Splats

from .looks import Eye

_SAMPLE = 12  # photographs in which the fit's own error is measured
_FEW = 4.0  # photographs that show half of the splats, below which a fit says little of how it looks from elsewhere
_FOLDS = 5


def expected_errors(
    eye: Eye,
    splats: Splats,
    views: Sequence[View | StreamedView],
    front_end: FrontEnd,
    *,
    gamma: float,
    fit_to: Callable[[Sequence[View | StreamedView]], Splats] | None = None,
    progress=None,
) -> Float[np.ndarray, " n"]:
    """The dissimilarity that each splat leaves in photographs: in a dozen of those that it was fitted to.

    A fit to few photographs explains them whatever it knows of the room. Where half of the splats are shown by fewer
    than four, the expectation is at least what scenes that were fitted without a photograph (`fit_to` some of the
    views) leave in that photograph: cross-validation in five folds. Without `fit_to` this is left out, and said;
    without `progress`, for scenes known to be shown often enough, it is not asked.
    """
    sampled = views[:: max(1, len(views) // _SAMPLE)]
    votes = [_votes(eye, splats, splats, view, front_end, gamma) for view in sampled]
    own = _mean_error(votes)
    if progress is None or _shown_by(votes) * len(views) / len(sampled) >= _FEW or len(views) < 2:
        return own
    if fit_to is None:
        progress.note(
            "few photographs show each place, and there are no points to fit without one: changes are doubtful"
        )
        return own
    progress.note("few photographs show each place: measuring how the scene looks in those it was not fitted to")
    held_out, folds = [], min(_FOLDS, len(views))
    for fold in range(folds):
        progress.step(fold, folds, "fits without some of the photographs")
        scene = fit_to([view for i, view in enumerate(views) if i % folds != fold])
        held_out += [_votes(eye, splats, scene, view, front_end, gamma) for view in views[fold::folds]]
    progress.step(folds, folds, "fits without some of the photographs")
    return np.maximum(own, _mean_error(held_out))


def _votes(
    eye: Eye, splats: Splats, shown: Splats, view: View | StreamedView, front_end: FrontEnd, gamma: float
) -> Float[np.ndarray, "n 2"]:
    """Per splat, over the pixels of a photograph: what it shows of them times the dissimilarity of `shown`, and what it
    shows."""
    unlike = 1 - similarity(eye.image(shown, view.camera), view.image.astype(np.float32) / 255, front_end, gamma=gamma)
    return eye.votes(splats, view.camera, np.stack([unlike * view.mask, view.mask], axis=-1))


def _mean_error(votes: Sequence[Float[np.ndarray, "n 2"]]) -> Float[np.ndarray, " n"]:
    total = np.sum(votes, axis=0, dtype=np.float64)
    # A prior of two pixels that disagree by half: what the photographs hardly showed is not to be relied on.
    return ((total[:, 0] + 2 * 0.5) / (total[:, 1] + 2)).astype(np.float32)


def _shown_by(votes: Sequence[Float[np.ndarray, "n 2"]]) -> float:
    """How many of these photographs show a splat, by what each shows of it: (Σv)² / Σv², of all splats the median."""
    shown = np.stack([vote[:, 1] for vote in votes]).astype(np.float64)
    return float(np.median(shown.sum(axis=0) ** 2 / np.maximum((shown**2).sum(axis=0), 1e-12)))
