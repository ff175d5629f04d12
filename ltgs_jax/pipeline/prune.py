"""Splats of later visits that buy nothing are left out: model only what a scene needs (design.md)."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool

from ltgs_jax.fit import VisitView
from ltgs_jax.scene import Splats, Template
from ltgs_jax.template import coarser

from .ledger import small_views, squared_error
from .looks import Eye, on_host
from .state import State, composed, cut_background, cut_template, extend_background

_PRICE = 6e-3  # growth of the squared error over all later photographs for which the splats that show least may go
_FEW = 8  # splats that a template must keep
_TRIALS = 4  # at how many of them may go
_FIRST = 0.05  # share of what they paint that the first trial leaves out
_AIM = 0.95  # of the price, at the trials after it
_PACE = 4.0  # times as much, at most, from one trial to the next


def late_splats(state: State, first: Splats) -> Bool[np.ndarray, " n"]:
    """Which splats, the background's and then each template's, are none of the `first` scene's, before any fit: what a
    later visit laid, built, or added to an object of the first, which has the world's frame."""
    chronology = state.chronology
    known = {row.tobytes() for row in np.asarray(first.means)}

    def came(template: Template) -> Bool[np.ndarray, " m"]:
        if template.source_visit > 0:
            return np.ones(template.splats.count, bool)
        return np.array([row.tobytes() not in known for row in np.asarray(template.splats.means)], bool)

    return np.concatenate([np.asarray(chronology.since) > 0, *map(came, chronology.templates)])


def drop_idle(
    state: State, late: Bool[np.ndarray, " n"], views: Sequence[VisitView], eye: Eye
) -> tuple[State, Bool[np.ndarray, " n"]]:
    """The state without as many as possible of its `late_splats`, those that show least first, at no more than a price
    in squared error over photographs of later visits (`small_views`); and which went, as a mask over the background's
    splats and then each template's.

    What came with the first visit stays as it is.
    """
    if not late.any():
        return state, late
    counts = [state.chronology.background.count, *(m.splats.count for m in state.chronology.templates)]
    owner = np.repeat(np.arange(len(counts)), counts)
    views = small_views(views)
    visits = {v.visit: [w for w in views if w.visit == v.visit] for v in views}
    scenes = {t: composed(state.chronology, t) for t in visits}
    showing = {t: np.asarray(scene.logit_opacities) > -np.inf for t, scene in scenes.items()}
    shown = np.zeros(len(owner))
    for t, seen in visits.items():
        scene = scenes[t][showing[t]]
        for v in seen:
            shown[showing[t]] += eye.votes(scene, v.view.camera, np.asarray(v.view.mask, np.float32)[..., None])[:, 0]
    order = np.flatnonzero(late)[np.argsort(shown[late], kind="stable")]

    def idle(count: int) -> Bool[np.ndarray, " n"]:
        gone = np.isin(np.arange(len(owner)), order[:count])
        left = np.bincount(owner[~gone], minlength=1 + len(state.chronology.templates))
        return gone & ((owner == 0) | (left >= _FEW)[owner])

    def error(gone: Bool[np.ndarray, " n"]) -> float:
        # By what is left out of scenes of one size: to cut each trial's out would compile for every one.
        each = [squared_error(scenes[t][showing[t] & ~gone], seen, eye) for t, seen in visits.items()]
        return float(np.mean(each))

    whole, low, high, target = max(error(idle(0)), 1e-12), 0, len(order) + 1, _FIRST
    painted = np.cumsum(shown[order]) / max(shown[order].sum(), 1e-12)
    for _ in range(_TRIALS):
        if high - low == 1:
            break
        count = int(np.clip(np.searchsorted(painted, target), low + 1, high - 1))
        growth = error(idle(count)) / whole - 1
        low, high = (count, high) if growth <= _PRICE else (low, count)
        # The error grows about as the square of what those left out had painted.
        target = max(painted[count - 1], 1e-6) * min((_AIM * _PRICE / max(growth, 1e-12)) ** 0.5, _PACE)
    gone = idle(low)
    return without(state, gone), gone


def without(state: State, gone: Bool[np.ndarray, " n"]) -> State:
    """The state without some of its splats, by a mask over the background's and then each template's."""
    ends = np.cumsum([state.chronology.background.count, *(m.splats.count for m in state.chronology.templates)])
    ground, *templates = np.split(gone, ends[:-1])
    state = cut_background(state, ground)
    for k, part in enumerate(templates):
        state = cut_template(state, k, part)
    return state


def merge_ground(state: State) -> State:
    """The state with the ground that later visits laid no denser than its colours ask for."""
    since = np.asarray(state.chronology.since)
    late = since > 0
    if not late.any():
        return state
    merged, row = coarser(on_host(state.chronology.background)[late], since[late])
    errors, guessed = np.zeros(merged.count, state.errors.dtype), np.zeros(merged.count, bool)
    np.maximum.at(errors, row, state.errors[late])
    np.logical_or.at(guessed, row, state.guessed[late])
    visit = since[late][np.unique(row, return_index=True)[1]]
    state = cut_background(state, late)
    for t in np.unique(visit):
        of = visit == t
        state = extend_background(state, merged[of], errors[of], guessed[of], int(t))
    return state
