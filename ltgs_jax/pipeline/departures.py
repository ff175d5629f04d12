"""What the photographs of a visit say has left its place: hidden, cut out, and the ground under it filled."""

from collections.abc import Sequence

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree

from ltgs_jax.fit import template_diameter
from ltgs_jax.scene import Splats, Template, concatenate_splats
from ltgs_jax.template import (
    Removal,
    Support,
    color_from_photographs,
    fill_under,
    find_removed,
    gone_evidence,
    share_of,
    taken_down,
    with_foot,
)

from .config import Config
from .ground import ground_shade
from .looks import Evidence, Eye, Observation, on_host, projection_of, vantage_of
from .state import (
    State,
    add_template,
    cut_background,
    extend_background,
    extend_template,
    hand_over,
    next_identity,
    set_from,
    split_template,
)

_LEAST_SEEN = 0.3  # pixels (αT) from which on a splat is seen
_CHANGED = 0.6  # share of them that changed, from which on it may be a streak of what left
_CLOSE = 0.15  # distance from that, in its sizes


class Remnant(eqx.Module):
    """A smaller piece that changed beside what had left: more of that (`whole`, a template), or ground that something
    else came to cover. Which, only what came can tell."""

    splats: Splats
    errors: Float[np.ndarray, " n"]
    whole: int = eqx.field(static=True)


def take_out(
    state: State,
    t: int,
    gone: dict[int, float],
    scene: tuple,
    observations: Sequence[Observation],
    evidence: Evidence,
    *,
    eye: Eye,
    config: Config,
    rng: np.random.Generator,
) -> tuple[State, dict[int, float], list[Remnant]]:
    """Hide the templates and cut out the background objects that the photographs say have left.

    `gone`: what left before in this visit, by template: the share of its evidence that says so; returned with what is
    new, and with the remnants of what had left before, which are in no template and no background. `scene`: what
    `scene_at` gave for this state.
    """
    before = tuple(gone)
    splats, _, owner, _ = scene
    votes = [
        eye.votes(splats, o.camera, np.stack([o.valid, change.left * o.valid, change.mask * o.valid], axis=-1))
        for o, change in zip(observations, evidence.changes, strict=True)
    ]
    seen, told = np.stack([v[:, 0] for v in votes]), np.stack([v[:, 1] for v in votes])
    pixels = int(np.mean([o.valid.size for o in observations]))
    gone = dict(gone)
    least = config.template.min_pixels * pixels
    for k in range(len(state.chronology.templates)):
        left, stayed = gone_evidence(seen[:, owner == k + 1], told[:, owner == k + 1])
        if left.sum() < least:
            continue
        upper = _taken_down(state, k, left, stayed, least, config)
        if upper is not None:
            part, support = upper
            # What the second look takes down as well is the foot of what the first did.
            joined = next((j for j in before if _went_along(state, t, j, k)), None)
            if joined is not None:
                state = hand_over(state, k, part, joined)
                lower = min(support, state.supports[joined], key=lambda level: level.offset)
                state = eqx.tree_at(lambda s, j=joined: s.supports[j], state, lower)
                continue
            state = split_template(state, k, part, support)
            left, stayed, k = left[part], stayed[part], len(state.chronology.templates) - 1
        if share_of(left, stayed) > config.template.whole:
            gone[k] = share_of(left, stayed)
            state = set_from(state, t, k, visible=False)
    base = owner == 0
    # Ground that a later visit laid or brought to light is no object, whatever came to stand there.
    laid = np.flatnonzero(base)[np.asarray(state.chronology.since) > 0]
    told[:, laid] = np.minimum(told[:, laid], 0)
    removals = find_removed(
        splats[base],
        seen[:, base],
        told[:, base],
        vantage_of(observations),
        pixels=pixels,
        rng=rng,
        config=config.template,
    )
    streaks = _streaks(state, t, gone, seen[:, base].sum(axis=0), sum(v[base, 2] for v in votes))
    return _cut_out(state, t, gone, before, removals, streaks, observations, config)


def _taken_down(
    state: State, k: int, left: Float[np.ndarray, " m"], stayed: Float[np.ndarray, " m"], least: float, config: Config
) -> tuple[Bool[np.ndarray, " m"], Support] | None:
    """The part of a template that was taken down from upon the rest, and the level it stood on; None where it left as
    a whole. What was carried together is one template until then."""
    support = state.supports[k]
    if support is None:
        return None
    points = np.asarray(state.chronology.templates[k].splats.means, np.float64) @ support.frame().T
    part = taken_down(points, left, stayed, least=least, config=config.template)
    if part is None:
        return None
    part, level = with_foot(points, part)
    return part, Support(support.normal, level, support.noise)


def _went_along(state: State, t: int, j: int, k: int) -> bool:
    """Whether template j has stood as template k in the same frame at all visits before t, and stands so no more."""
    poses, visible = state.chronology.world_from_template, np.asarray(state.chronology.visible)
    alike = all(np.array_equal(leaf[:t, j], leaf[:t, k]) for leaf in (poses.quat, poses.xyz, visible))
    sources = (state.chronology.templates[i].source_visit for i in (j, k))
    moved = np.asarray(poses.xyz)[:t, k].any()
    return bool(alike and moved and len(set(sources)) == 1 and not visible[t, j] and visible[t, k])


def _streaks(
    state: State, t: int, gone, seen: Float[np.ndarray, " n"], changed: Float[np.ndarray, " n"]
) -> dict[int, Bool[np.ndarray, " n"]]:
    """Background splats in or close around what was cut out before in this visit, clear of the ground and changed
    wherever they show: smooth ones, which no detail tells from something that came."""
    means = np.asarray(state.chronology.background.means, np.float64)
    free = (seen > _LEAST_SEEN) & (changed > _CHANGED * seen)
    found = {}
    for k in gone:
        support = state.supports[k]
        if support is None or not _stood_here(state, t, k):
            continue
        body = np.asarray(state.chronology.templates[k].splats.means, np.float64)
        clear = support.height(means) > 0.15 * np.quantile(support.height(body), 0.95)
        rows = np.flatnonzero(free & clear)
        reach = _CLOSE * template_diameter(state.chronology.templates[k].splats)
        near = rows[cKDTree(body).query(means[rows])[0] < reach]
        if len(near):
            found[k] = np.isin(np.arange(len(means)), near)
            free &= ~found[k]
    return found


def _stood_here(state: State, t: int, k: int) -> bool:
    """Whether a template left from where the first visit saw it."""
    template = state.chronology.templates[k]
    hidden = not bool(np.asarray(state.chronology.visible)[t:, k].any())
    return template.source_visit == 0 and hidden and np.abs(state.chronology.world_from_template[t, k].xyz).max() == 0


def _cut_out(state: State, t: int, gone, before, removals: Sequence[Removal], streaks, observations, config: Config):
    """Templates of the removals, more splats for those they were torn from, or remnants of what had left `before`; the
    ground under them filled."""
    background, errors = state.chronology.background, state.errors
    taken = np.zeros(background.count, bool)
    fills, remnants = [], []
    for removal in removals:
        piece = background[removal.members]
        k = _torn_from(state, piece, gone, t)
        if k is None and removal.support is not None:
            others = background[~(removal.members | taken)]
            if ground_shade(piece, removal.support, others)[0]:
                k = _torn_from(state, piece, range(len(state.chronology.templates)), t)
                if k is None:
                    continue
        if k is None:
            template = Template(piece, next_identity(state), 0)
            state = add_template(state, template, errors[removal.members], removal.support, 0)
            k = len(state.chronology.templates) - 1
            state = set_from(state, t, k, visible=False)
            gone[k] = removal.share
        elif k in before:
            remnants.append(Remnant(piece, errors[removal.members], k))
        else:
            state = extend_template(state, k, piece, errors[removal.members])
        taken |= removal.members
        if removal.support is not None:
            fills.append((np.asarray(piece.means, np.float64), removal.support))
    for k, members in streaks.items():
        members = members & ~taken
        if members.any():
            state = extend_template(state, k, background[members], errors[members])
            taken |= members
    if not taken.any():
        return state, gone, remnants
    state = cut_background(state, taken)
    rest = state.chronology.background
    new = [on_host(fill_under(rest, points, support, config=config.template)) for points, support in fills]
    if sum(part.count for part in new):
        projections = [projection_of(o.camera) for o in observations]
        ground, seen_there = color_from_photographs(
            concatenate_splats(new), projections, [o.image for o in observations]
        )
        # Its colours are guesses: only a strong difference there says that something came.
        doubt = np.where(seen_there, 0.5, 1.0) * config.detect.guessed
        state = extend_background(state, on_host(ground), doubt, np.ones(ground.count, bool), t)
    return state, gone, remnants


def _torn_from(state: State, piece: Splats, among, t: int) -> int | None:
    """The template, of those `among` that came with the first visit, that a piece in or beside it, and no larger,
    belongs to."""
    means = np.asarray(piece.means)
    for k in among:
        if not _stood_here(state, t, k):
            continue
        template = state.chronology.templates[k]
        size = template_diameter(template.splats)
        distance = cKDTree(np.asarray(template.splats.means)).query(means)[0]
        if np.median(distance) < 0.2 * size and template_diameter(piece) < 1.1 * size:
            return k
    return None
