"""Splats of later visits that buy nothing are left out: model only what a scene needs (design.md)."""

from collections.abc import Sequence

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Int

from ltgs_jax.fit import VisitView

from .ledger import squared_error
from .looks import Eye
from .state import State, composed, cut_background

_PRICE = 2e-3  # growth of the squared error over all later photographs for which the splats that show least may go
_FEW = 8  # splats that a template must keep
_HALVINGS = 6  # of the number of splats in question


def drop_idle(state: State, views: Sequence[VisitView], eye: Eye) -> tuple[State, int]:
    """The state without as many as possible of the splats that later visits added, those that show least first, at no
    more than a price in squared error over photographs of later visits; and how many went.

    What came with the first visit stays as it is.
    """
    owner, late = _late_splats(state)
    if not late.any():
        return state, 0
    shown = np.zeros(len(owner))
    for v in views:
        splats = composed(state.chronology, v.visit)
        rows = np.flatnonzero(np.asarray(splats.logit_opacities) > -np.inf)
        everywhere = np.asarray(v.view.mask, np.float32)[..., None]
        shown[rows] += eye.votes(splats[rows], v.view.camera, everywhere)[:, 0]
    order = np.flatnonzero(late)[np.argsort(shown[late], kind="stable")]
    most = (1 + _PRICE) * _error(state, views, eye)
    kept, low, high = state, 0, len(order) + 1
    # The error grows with the number of those left out: halving finds the most.
    for _ in range(_HALVINGS):
        count = (low + high) // 2
        trial = _without(state, owner, np.isin(np.arange(len(owner)), order[:count]))
        if _error(trial, views, eye) <= most:
            kept, low = trial, count
        else:
            high = count
    return kept, len(owner) - len(_late_splats(kept)[0])


def _late_splats(state: State) -> tuple[Int[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
    """Whose each splat is (0 the background's, 1 + k template k's), and whether a later visit added it."""
    chronology = state.chronology
    counts = [chronology.background.count, *(m.splats.count for m in chronology.templates)]
    came = [np.full(m.splats.count, m.source_visit > 0) for m in chronology.templates]
    return np.repeat(np.arange(len(counts)), counts), np.concatenate([np.asarray(chronology.since) > 0, *came])


def _without(state: State, owner: Int[np.ndarray, " n"], idle: Bool[np.ndarray, " n"]) -> State:
    state = cut_background(state, idle[owner == 0])
    for k, template in enumerate(state.chronology.templates):
        keep = ~idle[owner == k + 1]
        if keep.sum() < _FEW:
            continue
        state = eqx.tree_at(
            lambda s, k=k: (s.chronology.templates[k].splats, s.template_errors[k]),
            state,
            (template.splats[keep], state.template_errors[k][keep]),
        )
    return state


def _error(state: State, views: Sequence[VisitView], eye: Eye) -> float:
    """Mean squared error over photographs of later visits, each visit's weighed alike."""
    visits = sorted({v.visit for v in views})
    return float(np.mean([squared_error(state.chronology, t, [v for v in views if v.visit == t], eye) for t in visits]))
