"""What came as new and is an object known before: its look changed, or it shows sides that no photograph had seen."""

import dataclasses
from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.optimize import linear_sum_assignment

from ltgs_jax.fit import template_diameter
from ltgs_jax.geometry import C0, SE3
from ltgs_jax.scene import Splats, transform_splats
from ltgs_jax.template import Support, middle_of

from .looks import on_host
from .state import Account, State, middles_of

APART = 0.5  # between the middles of two states, in sizes of the larger, up to which one is in the other's place
_FACTOR = 2.5  # between the sizes of two states of an object in one place
_SHAPE = 1.4  # between the heights, and between the widths, of two states of an object in different places
_COMMON = 0.55  # share of their colours that two states have in common
_COMMON_ELSEWHERE = 0.4  # the same where their shapes agree
_STANDS_OUT = 1.3  # times what is new has in common with any other object; where all are alike, colours tell nothing
_BINS = 6  # of each channel


def join_states(state: State, t: int, accounts: Sequence[Account]) -> tuple[State, list[Account]]:
    """What visit t's accounts call added, where it is an object that does not show any more: the new template gets the
    identity of the old one, and one account in place of two.

    In the place of what left at this visit, of its colours and another shape, it is a new state (section 3.2 of the
    LTGS paper: changed geometry). Elsewhere, of the colours and the shape of something that left now or before, it has
    moved, or is back, and shows sides that tell nothing of how it turned: its frame is that of the old template,
    shifted; unless its outlines were compared with those of what came, and are others. No other known object may have
    nearly as many colours in common with it. Only something new takes part. Of several, pairs with the most colours in
    common. What stays new though it has colours of something hidden, and nothing in its shape speaks against that, is
    less certain by their share.
    """
    templates, visible = state.chronology.templates, np.asarray(state.chronology.visible)
    shown = {m.identity for k, m in enumerate(templates) if visible[t, k]}
    hidden = [k for k, m in enumerate(templates) if m.identity not in shown and visible[:t, k].any()]
    came = [a for a in accounts if a.kind == "added" and templates[a.template].source_visit == t]
    if not hidden or not came:
        return state, list(accounts)
    in_place = np.array([[_in_place(state, t, k, a.template) for a in came] for k in hidden])
    one_shape = np.array([[_of_one_shape(state, k, a.template) for a in came] for k in hidden])
    known = [k for k in range(len(templates)) if k not in {a.template for a in came}]
    shared = np.array([[_in_common(state, k, a.template) for a in came] for k in known])
    common = shared[[known.index(k) for k in hidden]]
    others = [[templates[o].identity != templates[k].identity for o in known] for k in hidden]
    rival = np.max(np.where(np.asarray(others)[..., None], shared, 0), axis=1)
    ruled_out = np.array([[templates[k].identity in a.other_than for a in came] for k in hidden])
    distinct = (common > _STANDS_OUT * rival) & ~(ruled_out & ~in_place)
    # What has not changed its shape, and stands in its place, some pose of the old template explains.
    alike = distinct & np.where(in_place, ~one_shape & (common > _COMMON), one_shape & (common > _COMMON_ELSEWHERE))
    shapeless = np.array(
        [[state.supports[k] is None or state.supports[a.template] is None for a in came] for k in hidden]
    )
    doubt = np.max(np.where(distinct & (in_place | one_shape | shapeless), common, 0), axis=0)
    replaced = {
        a.template: dataclasses.replace(a, gain=float(a.gain * (1 - d))) for a, d in zip(came, doubt, strict=True)
    }
    again = set()
    for i, j in zip(*linear_sum_assignment(-np.where(alike, common, 0)), strict=True):
        old, account = hidden[i], came[j]
        identity = templates[old].identity
        if not alike[i, j] or identity in again:
            continue
        again.add(identity)
        state = _renamed(state, account.template, identity)
        was_there = any(visible[t - 1, k] for k, m in enumerate(templates) if m.identity == identity)
        kind = "new_state" if in_place[i, j] else "moved" if was_there else "added"
        axis = account.ambiguous_axis
        if not in_place[i, j]:
            state = _in_frame_of(state, t, account.template, old)
            axis = tuple(map(float, state.supports[account.template].normal))
        share = account.gain * float(common[i, j])
        replaced[account.template] = dataclasses.replace(account, kind=kind, gain=share, ambiguous_axis=axis)
    identities = [m.identity for m in state.chronology.templates]
    kept = [a for a in accounts if a.kind != "removed" or identities[a.template] not in again]
    return state, [replaced.get(a.template, a) for a in kept]


def _renamed(state: State, k: int, identity: int) -> State:
    template = dataclasses.replace(state.chronology.templates[k], identity=identity)
    return eqx.tree_at(lambda s: s.chronology.templates[k], state, template)


def _in_frame_of(state: State, t: int, new: int, old: int) -> State:
    """The state with a template that came at visit t, and stands where its frame is, in the frame of another, shifted
    from middle to middle."""
    own = middle_of(np.asarray(state.chronology.templates[old].splats.means))
    shift = np.asarray(middles_of(state, new)[t] - own, np.float32)
    back = SE3(jnp.asarray([1.0, 0, 0, 0], jnp.float32), jnp.asarray(-shift))
    xyz = np.array(state.chronology.world_from_template.xyz)
    xyz[:, new] = shift
    return eqx.tree_at(
        lambda s: (s.chronology.templates[new].splats, s.supports[new], s.chronology.world_from_template.xyz),
        state,
        (
            on_host(transform_splats(back, state.chronology.templates[new].splats)),
            state.supports[new].moved(back),
            xyz,
        ),
    )


def _in_place(state: State, t: int, old: int, new: int) -> bool:
    """Whether a template came about where another left at visit t, and is not much larger or smaller."""
    if not np.asarray(state.chronology.visible)[t - 1, old]:
        return False
    sizes = [template_diameter(state.chronology.templates[k].splats) for k in (old, new)]
    apart = np.linalg.norm(middles_of(state, new)[t] - middles_of(state, old)[t - 1])
    return bool(apart <= APART * max(sizes) and max(sizes) <= _FACTOR * min(sizes))


def _of_one_shape(state: State, old: int, new: int) -> bool:
    """Whether two templates are about as high above what they stand on, and as wide."""
    if state.supports[old] is None or state.supports[new] is None:
        return False
    a, b = (_shape(state.chronology.templates[k].splats, state.supports[k]) for k in (old, new))
    return bool((np.maximum(a, b) < _SHAPE * np.minimum(a, b)).all())


def _shape(splats: Splats, support: Support) -> Float[np.ndarray, "2"]:
    """Height and width of what shows of an object, in scene units: how high it reaches, and the side of the square over
    which as much would be spread."""
    points = np.asarray(splats.means, np.float64)[np.asarray(splats.opacities) > 0.1]
    flat = np.cov(points @ support.frame()[:2].T, rowvar=False)
    return np.array([np.quantile(support.height(points), 0.97), np.sqrt(12) * np.linalg.det(flat) ** 0.25])


def _in_common(state: State, old: int, new: int) -> float:
    """Share of colours that two templates have in common."""
    before, after = (_histogram(state.chronology.templates[k].splats) for k in (old, new))
    return float(np.minimum(before, after).sum())


def _histogram(splats: Splats) -> Float[np.ndarray, " b"]:
    """Shares of the colours, each splat by its opacity and the area of its two longer axes."""
    colors = np.clip(np.asarray(splats.sh[:, 0], np.float64) * C0 + 0.5, 0, 1 - 1e-9)
    area = np.exp(np.sort(np.asarray(splats.log_scales, np.float64), axis=1)[:, 1:].sum(axis=1))
    bins = np.ravel_multi_index(tuple((colors * _BINS).astype(int).T), (_BINS,) * 3)
    counts = np.bincount(bins, area * np.asarray(splats.opacities), minlength=_BINS**3)
    return counts / max(counts.sum(), 1e-12)
