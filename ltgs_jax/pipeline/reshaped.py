"""Objects that changed their shape: what left, and what came in its place with its colours, are one object."""

import dataclasses
from collections.abc import Sequence

import equinox as eqx
import numpy as np
from jaxtyping import Float
from scipy.optimize import linear_sum_assignment

from ltgs_jax.fit import template_diameter
from ltgs_jax.geometry import C0
from ltgs_jax.scene import Splats

from .state import Account, State, middles_of

_APART = 0.5  # between the middles of two states, in sizes of the larger, up to which one is in the other's place
_FACTOR = 2.5  # between the sizes of two states of an object
_COMMON = 0.6  # share of their colours that two states have in common
_BINS = 4  # of each channel


def join_states(state: State, t: int, accounts: Sequence[Account]) -> tuple[State, list[Account]]:
    """What visit t's accounts call removed and added, where it is one object in a new state: the new template gets the
    identity of the old one, and one account in place of two (section 3.2 of the LTGS paper: changed geometry).

    Only something new takes part: a known template elsewhere has moved. Of several, pairs with the most colours in
    common.
    """
    templates = state.chronology.templates
    left = [a for a in accounts if a.kind == "removed"]
    came = [a for a in accounts if a.kind == "added" and templates[a.template].source_visit == t]
    if not left or not came:
        return state, list(accounts)
    common = np.array([[_in_common(state, t, a.template, b.template) for b in came] for a in left])
    dropped, kinds = set(), {}
    for i, j in zip(*linear_sum_assignment(-common), strict=True):
        if common[i, j] > _COMMON:
            old, new = left[i].template, came[j].template
            identity = templates[old].identity
            renamed = dataclasses.replace(state.chronology.templates[new], identity=identity)
            state = eqx.tree_at(lambda s, k=new: s.chronology.templates[k], state, renamed)
            dropped.add(old)
            kinds[new] = "new_state"
    kept = [a for a in accounts if a.template not in dropped]
    return state, [dataclasses.replace(a, kind=kinds.get(a.template, a.kind)) for a in kept]


def _in_common(state: State, t: int, old: int, new: int) -> float:
    """Share of colours that two templates have in common; 0 where they differ in place, or much in size."""
    before, after = (state.chronology.templates[k].splats for k in (old, new))
    sizes = template_diameter(before), template_diameter(after)
    apart = np.linalg.norm(middles_of(state, new)[t] - middles_of(state, old)[t - 1])
    if apart > _APART * max(sizes) or max(sizes) > _FACTOR * min(sizes):
        return 0.0
    return float(np.minimum(_histogram(before), _histogram(after)).sum())


def _histogram(splats: Splats) -> Float[np.ndarray, " b"]:
    """Shares of the colours, each splat by its opacity and the area of its two longer axes."""
    colors = np.clip(np.asarray(splats.sh[:, 0], np.float64) * C0 + 0.5, 0, 1 - 1e-9)
    area = np.exp(np.sort(np.asarray(splats.log_scales, np.float64), axis=1)[:, 1:].sum(axis=1))
    bins = np.ravel_multi_index(tuple((colors * _BINS).astype(int).T), (_BINS,) * 3)
    counts = np.bincount(bins, area * np.asarray(splats.opacities), minlength=_BINS**3)
    return counts / max(counts.sum(), 1e-12)
