"""What came in a visit: known templates at new poses, new objects, or ground that was hidden before."""

import dataclasses
from collections.abc import Sequence
from functools import cache

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float
from scipy.cluster.vq import kmeans2
from scipy.optimize import linear_sum_assignment
from scipy.spatial import ConvexHull, cKDTree

from ltgs_jax.detect import dilate
from ltgs_jax.features import FrontEnd
from ltgs_jax.fit import Windows, fit_local, template_diameter
from ltgs_jax.match import Instance, find_instances
from ltgs_jax.scene import Splats, Template, pad_splats, transform_splats
from ltgs_jax.template import (
    Crop,
    Placement,
    Search,
    Support,
    backdrop_unlikeness,
    build_template,
    explained,
    firm_part,
    make_crop,
    place_template,
    search_template,
    settle_template,
    support_below,
)

from .config import Config
from .ground import ground_shade, light_alone
from .looks import Evidence, Eye, Observation, compare, cone_of, on_host, still_changed, vantage_of
from .matched import SIDE, Matcher
from .state import (
    Account,
    State,
    add_template,
    extend_background,
    extend_template,
    middles_of,
    next_identity,
    scene_at,
    set_from,
)

_MOST = 1.3  # share of the change that an account of it may explain: beyond, it improves what did not change
_PARTLY_KNOWN = 0.3  # pixels beside a known object that changed with it, per pixel of it, to be something else
_ROOM = 1.3  # extent of an arrival, in sizes of an object, from which on it is looked for in each part of it
_BARED = 0.5  # share of what came, over which it lies where something that left had hidden the ground
_SHOWN = 0.6  # share of a new object that must show: what lies in and under what was known is no object
_STARK = 0.7  # unlikeness in its outlines, in most photographs, that is no shade or ground: haze may hide the object
_HAZED = 0.3  # share of such an object that must show
_COVERED = 0.25  # share of what changed clearly that a template must cover after the search, to be looked at closely
_BEHIND = 0.2  # share of the change by which another may explain less than one that is sure, to be looked at closely
_APART = 0.2  # share of the smaller of two outlines, up to which they may overlap and be of things side by side
_COMPACT = 0.6  # share of its convex hull that an outline fills, from which on it is a shape: of shreds it is half
_CLINGS = 0.3  # distance, in sizes of a new object, to what stands there, within which it is a patch of that
_FLOATS = 0.25  # height of the lowest of a new object, in its sizes, from which on nothing carries it
_SHADE_LENGTH = 2.0  # in sizes of an object: how far from its middle its shadow reaches
_FLAT = 0.2  # share of a new object above that height, below which it lies flat on its surface and clings to nothing
_LOW = 0.1  # height, in diameters of a new object, under which what mends the surface around it belongs to that


class Arrival(eqx.Module):
    """Something that came: its volume and outlines, the surface below, windows around it, as poses are compared in and
    as they are matched in, the share of it that may be ground that nobody saw before, since it was guessed, or
    something stood there and left, and the gain on the colours that were there, if that is all."""

    instance: Instance
    support: Support
    crop: Crop
    window: Crop
    bared: float
    light: float | None


class NewObject(eqx.Module):
    """A change as something never seen before: its splats after a short fit, those of them that are firm, its outlines
    in the windows, what is left unlike the photographs, the share of the change that it explains, and that what it
    draws within its outlines does, and how unlike the photographs they were without it, in the middle one of them."""

    template: Template
    firm: Bool[np.ndarray, " n"]
    outlines: Bool[np.ndarray, "v s s"]
    error: float
    gain: float
    own_gain: float
    contrast: float


Unknown = tuple[Arrival, NewObject | None, tuple[int, ...]]
"""What no known template explains, as something new, and the identities whose outlines it has not."""


def place_arrivals(
    state: State,
    t: int,
    gone: dict[int, float],
    instances: Sequence[Instance],
    observations: Sequence[Observation],
    evidence: Evidence,
    bared: Sequence[Bool[np.ndarray, "h w"]],
    surface: Float[np.ndarray, "n 3"],
    front_end: FrontEnd,
    *,
    eye: Eye,
    config: Config,
    rng: np.random.Generator,
    progress,
) -> tuple[State, list[Account]]:
    """Known templates for what came, by photometric evidence and one assignment; new objects for the rest.

    `gone`: templates that left their place in this visit. `bared`: the pixels that show guessed ground, or
    did show what left. `surface`: points of the known scene.
    """
    tools = {"config": config, "rng": rng, "progress": progress}

    def arrivals_of(instances: Sequence[Instance], evidence: Evidence) -> list[Arrival]:
        return _arrivals_of(instances, t, observations, evidence, bared, surface, **tools)

    placing = {"eye": eye, **tools}
    arrivals = arrivals_of(instances, evidence)
    state, accounts, known, rest = _place_known(state, t, gone, arrivals, observations, evidence, front_end, **placing)
    beside = _beside(state, t, known, observations, evidence, eye=eye, config=config)
    if any(region.any() for region in beside):
        after = compare(eye, scene_at(state, t), observations, front_end, config)
        cones = [
            cone_of(o.camera, dilate(r & m, config.detect.dilate) & o.valid, o.valid, look)
            for o, r, m, look in zip(observations, beside, after.masks, after.looks, strict=True)
        ]
        found = [instance for instance in find_instances(cones, surface, config=config.match) if instance.views > 1]
        more = arrivals_of(found, after)
        state, added, _, left = _place_known(state, t, gone, more, observations, after, front_end, **placing)
        accounts, rest = accounts + added, rest + left
    for arrival, new, others in rest:
        after, account = _add_new(state, t, arrival, new, config, progress)
        shown = 1.0 if account is None else _shown(after, t, account.template, observations, eye=eye)
        if shown < (_HAZED if new is not None and new.contrast > _STARK else _SHOWN):
            progress.note(f"visit {t}: a change left out, as a new object {shown:.2f} of it shows")
            continue
        state = after
        if account is not None:
            accounts = [*accounts, dataclasses.replace(account, other_than=others)]
    return state, accounts


def _arrivals_of(
    instances: Sequence[Instance], t: int, observations, evidence: Evidence, bared, surface, *, config: Config, rng,
    progress,
) -> list[Arrival]:  # fmt: skip
    """Instances with what is below and around them; those above no surface are left out."""
    arrivals = []
    vantage = vantage_of(observations)
    for instance in instances:
        support = support_below(instance, surface, np.ones(len(surface)), vantage, rng=rng)
        if support is None:
            progress.note(f"visit {t}: a change seen in {instance.views} photographs has no surface below; left out")
            continue
        share = sum((r & b).sum() for r, b in zip(instance.regions, bared, strict=True))
        share /= max(sum(r.sum() for r in instance.regions), 1)
        crop, window = (crop_around(instance, observations, evidence, s) for s in (config.template.window, SIDE))
        changed = [r & m & o.valid for r, m, o in zip(instance.regions, evidence.masks, observations, strict=True)]
        light = light_alone([o.image for o in observations], [look.image for look in evidence.looks], changed)
        arrivals.append(Arrival(instance, support, crop, window, float(share), light))
    return arrivals


def _place_known(
    state: State,
    t: int,
    gone: dict[int, float],
    arrivals: Sequence[Arrival],
    observations: Sequence[Observation],
    evidence: Evidence,
    front_end: FrontEnd,
    *,
    eye: Eye,
    config: Config,
    rng,
    progress,
) -> tuple[State, list[Account], list[tuple[Arrival, int]], list[Unknown]]:
    """Hidden templates where they explain an arrival: the state, an account of each, which is which, and the rest."""

    @cache
    def as_new(i: int) -> NewObject | None:
        return _as_new(state, t, arrivals[i], observations, evidence, config=config, rng=rng)

    def is_ground(i: int) -> bool:
        new, arrival = as_new(i), arrivals[i]
        if new is None or not _explains(new, config):
            return False
        return bool(_ground(state, t, arrival, new.template.splats[new.firm])[0])

    # What may be ground is first looked at as that: for a known object it need not be searched.
    doubted = [i for i, arrival in enumerate(arrivals) if arrival.bared > _BARED or arrival.light is not None]
    things = [i for i in range(len(arrivals)) if i not in doubted or not is_ground(i)]
    placements = _placements(state, t, arrivals, things, front_end, eye=eye, config=config, rng=rng, progress=progress)
    looked_at, identities = dict(placements), [m.identity for m in state.chronology.templates]
    unlike: dict[int, set[int]] = {i: set() for i in range(len(arrivals))}
    for (i, k), found in _unsure(looked_at, config).items():
        new, why = as_new(i), ""
        if new is not None:
            others = [other for (j, m), other in looked_at.items() if j == i and m != k]
            shape = _shape_beside(found, others, new, arrivals[i].crop, config)
            share = found.gain / min(max(new.gain, 1e-3), 1)
            if shape < config.template.tau_shape or share < config.template.tau_share:
                why = f"their outlines overlap by {shape:.2f}, and it explains {share:.2f} of what a new object would"
            if shape < config.template.tau_shape:
                unlike[i].add(identities[k])
        if not why:
            trial = scene_at(set_from(state, t, k, visible=True, pose=found.world_from_template), t)
            with_it = compare(eye, trial, observations, front_end, config)
            remains = still_changed(trial, k, observations, evidence, with_it, eye=eye)
            if remains > 1:
                why = f"with it there, {remains:.2f} times as many pixels are changed as without it"
        if why:
            progress.note(f"visit {t}: arrival {i} is not object {identities[k]}: {why}")
            del placements[i, k]
    accounts, known, rest = [], [], []
    for i, k in _assigned(len(arrivals), placements, identities, config):
        if k is None:
            rest.append((arrivals[i], as_new(i), tuple(sorted(unlike[i]))))
            continue
        found = placements[i, k]
        state = set_from(state, t, k, visible=True, pose=found.world_from_template, unsure=config.detect.moved)
        kind = "moved" if k in gone else "added"
        accounts.append(Account.of_placed(k, kind, found, arrivals[i].instance.views))
        known.append((arrivals[i], k))
    return state, accounts, known, rest


def _beside(
    state: State, t: int, known: Sequence[tuple[Arrival, int]], observations, evidence: Evidence, *, eye: Eye,
    config: Config,
) -> list[Bool[np.ndarray, "h w"]]:  # fmt: skip
    """The pixels within the outlines of arrivals that a known template explains only in part: of something else, taken
    for one thing with it."""
    scene = scene_at(state, t)
    rest = [np.zeros_like(mask) for mask in evidence.masks]
    for arrival, k in known:
        cover = eye.cover(scene, [k], observations)
        parts = [
            region & mask & ~dilate(c, config.detect.dilate)
            for region, mask, c in zip(arrival.instance.regions, evidence.masks, cover, strict=True)
        ]
        if sum(part.sum() > _PARTLY_KNOWN * max(c.sum(), 1) for part, c in zip(parts, cover, strict=True)) >= 2:
            rest = [r | part for r, part in zip(rest, parts, strict=True)]
    return rest


def convincing(found: Placement, config: Config) -> bool:
    """Whether a known template, as placed, is what came."""
    good = found.overlap > config.template.tau_outline and found.worth > config.template.tau_same
    return good and found.gain <= _MOST


def _window(instance: Instance, observations) -> list[tuple[float, float, float]]:
    """A square around the instance's outline in each photograph; where it has none, around its projected points."""
    boxes = []
    for o, region in zip(observations, instance.regions, strict=True):
        if region.any():
            rows, columns = np.nonzero(region)
        else:
            xy, z = o.camera.project(jnp.asarray(instance.points, jnp.float32))
            xy = np.asarray(xy)[np.asarray(z) > 1e-3]
            if len(xy) == 0:
                xy = np.zeros((1, 2))
            rows, columns = xy[:, 1], xy[:, 0]
        top, bottom = np.quantile(rows, [0.0, 1.0])
        left, right = np.quantile(columns, [0.0, 1.0])
        side = max(1.6 * max(bottom - top, right - left), 24.0)
        boxes.append(((left + right - side) / 2, (top + bottom - side) / 2, side))
    return boxes


def crop_around(instance: Instance, observations, evidence: Evidence, size: int) -> Crop:
    """Windows of the photographs around an instance, `size` pixels wide, in which other changes do not count."""
    regions = [dilate(region, 2) for region in instance.regions]
    return make_crop(
        [o.camera for o in observations],
        [o.image for o in observations],
        [look.image for look in evidence.looks],
        [look.depth for look in evidence.looks],
        # Pixels that other arrivals changed say nothing about this one.
        [
            o.valid & (region | ~dilate(mask, 2))
            for o, region, mask in zip(observations, regions, evidence.masks, strict=True)
        ],
        [region & o.valid for o, region in zip(observations, regions, strict=True)],
        _window(instance, observations),
        size=size,
    )


def _placements(
    state: State, t: int, arrivals: Sequence[Arrival], things: Sequence[int], front_end: FrontEnd, *, eye: Eye,
    config: Config, rng, progress,
) -> dict[tuple[int, int], Placement]:  # fmt: skip
    """Where each hidden template would stand as each arrival that may be a thing (`things`): the best few by search and
    matches, then settled."""
    placements = {}
    matcher = Matcher(state, front_end, config)
    hidden = [k for k in range(len(state.chronology.templates)) if not bool(state.chronology.visible[t, k])]
    sizes = {k: template_diameter(state.chronology.templates[k].splats) for k in hidden}
    for i in things:
        arrival = arrivals[i]
        searches = _searches(state, t, arrival, sizes, matcher, eye=eye, config=config, rng=rng)
        ranked = sorted(searches, key=lambda k: -searches[k].best_gain)[: config.template.candidates]
        least = config.template.tau_gain
        for k in ranked:
            looks = {"size": sizes[k], "refiner": eye.refiner}
            if searches[k].best_gain <= least:
                continue
            if place_template(searches[k], searches[k].poses[0], arrival.crop, **looks).recall < _COVERED:
                continue
            found = placements[i, k] = settle_template(searches[k], arrival.crop, **looks)
            if found.worth > config.template.tau_sure:
                least = max(least, searches[k].best_gain - _BEHIND)
            identity = state.chronology.templates[k].identity
            progress.note(
                f"visit {t}: arrival {i} as object {identity}: explains {found.gain:.2f}, "
                f"outline {found.overlap:.2f}, likeness {found.likeness:.2f}, recall {found.recall:.2f}, "
                f"by {found.evidence}"
            )
    return placements


def _searches(
    state: State, t: int, arrival: Arrival, sizes: dict[int, float], matcher: Matcher, *, eye: Eye, config: Config, rng
) -> dict[int, Search]:
    """Poses of the templates that have room in an arrival: upright, or as what matches says, and, where none explains
    it so, on their other sides."""

    def search(k: int, upright: bool) -> Search:
        return search_template(
            state.chronology.templates[k],
            state.supports[k],
            arrival.support,
            _places(arrival.instance.points, sizes[k]),
            arrival.crop,
            size=sizes[k],
            refiner=eye.refiner,
            rng=rng,
            before=state.chronology.world_from_template[t - 1, k] if upright else None,
            upright=upright,
            matched=matcher.poses(k, arrival.window, arrival.instance) if upright else {},
            config=config.template,
        )

    able = [k for k in sizes if state.supports[k] is not None and _sizes_agree(arrival.instance, sizes[k])]
    found = {k: search(k, True) for k in able}
    if all(each.best_gain <= config.template.tau_search for each in found.values()):
        found = {k: max(each, search(k, False), key=lambda s: s.best_gain) for k, each in found.items()}
    return found


def _assigned(
    count: int, placements: dict[tuple[int, int], Placement], identities: Sequence[int], config: Config
) -> list[tuple[int, int | None]]:
    """Each arrival with the template it is, or None for a new object: one assignment of identities, of which each has
    its best template, best evidence in total."""
    good = {pair: found.worth for pair, found in placements.items() if convincing(found, config)}
    known = sorted({identities[k] for _, k in good})
    cost = np.zeros((count, len(known) + count))
    best: dict[tuple[int, int], int] = {}
    for (i, k), worth in sorted(good.items(), key=lambda item: item[1]):
        j = known.index(identities[k])
        cost[i, j], best[i, j] = -worth, k
    pairs = zip(*linear_sum_assignment(cost), strict=True) if count else ()
    return [(int(i), best.get((i, j))) for i, j in pairs]


def _as_new(
    state: State, t: int, arrival: Arrival, observations, evidence: Evidence, *, config: Config, rng
) -> NewObject | None:
    """An arrival as something never seen before; None where its outlines enclose nothing."""
    cones = [cone_of(o.camera, o.valid, o.valid, look) for o, look in zip(observations, evidence.looks, strict=True)]
    template = build_template(
        arrival.instance,
        arrival.support,
        cones,
        [o.image for o in observations],
        identity=next_identity(state),
        visit=t,
        coefficients=state.chronology.background.sh.shape[1],
        rng=rng,
        config=config.template,
    )
    if template is None:
        return None
    template, images, error, gain = _settle_new(template, arrival.crop, config)
    firm, outlines = firm_part(template.splats, arrival.crop)
    # What it draws beside its outlines mends what is around it, where the scene was poorly known.
    within = np.where(np.stack([dilate(outline, 2) for outline in outlines])[..., None], images, arrival.crop.backdrop)
    without, seen = backdrop_unlikeness(arrival.crop), outlines & np.asarray(arrival.crop.valid)
    contrasts = [float(np.median(u[pixels])) for u, pixels in zip(without, seen, strict=True) if pixels.any()]
    gains = error, gain, explained(within, arrival.crop)[1]
    return NewObject(template, firm, outlines, *gains, float(np.median(contrasts)) if contrasts else 0.0)


def _unsure(placements: dict[tuple[int, int], Placement], config: Config) -> dict[tuple[int, int], Placement]:
    """The pairs that are convincing, but not beyond doubt."""
    return {
        pair: found
        for pair, found in placements.items()
        if convincing(found, config) and found.worth <= config.template.tau_sure
    }


def _shape_beside(found: Placement, others: Sequence[Placement], new: NewObject, crop: Crop, config: Config) -> float:
    """How far a template's outlines are those of the change as a new object; or its outlines and those of another that
    is convincing and stands beside it, taken for one thing with it."""
    beside = [
        other.outlines for other in others if convincing(other, config) and _apart(found.outlines, other.outlines)
    ]
    every = found.outlines, *(found.outlines | outlines for outlines in beside)
    return max(_same_shape(outlines, new, crop) for outlines in every)


def _apart(a: Bool[np.ndarray, "v s s"], b: Bool[np.ndarray, "v s s"]) -> bool:
    """Whether two outlines hardly overlap."""
    return (a & b).sum() < _APART * min(a.sum(), b.sum())


def _same_shape(outlines: Bool[np.ndarray, "v s s"], new: NewObject, crop: Crop) -> float:
    """The least overlap (IoU) of outlines with those of a change as a new object, over the views that show enough of
    it and in which the new one has a shape to compare; 1 where none has."""
    valid = np.asarray(crop.valid)
    both = (outlines & new.outlines & valid).sum(axis=(1, 2))
    either = ((outlines | new.outlines) & valid).sum(axis=(1, 2))
    enough = either > max(0.2 * either.max(), 8)
    judges = enough & [outline.sum() > _COMPACT * _hull_area(outline) for outline in new.outlines]
    return float(np.min(both[judges] / either[judges], initial=1.0))


def _hull_area(outline: Bool[np.ndarray, "s s"]) -> float:
    """Pixels within the convex hull of an outline's pixels, corners and all; 0 of none."""
    corners = np.argwhere(outline)[:, None] + np.array([[0, 0], [0, 1], [1, 0], [1, 1]])
    return float(ConvexHull(corners.reshape(-1, 2)).volume) if outline.any() else 0.0


def _add_new(
    state: State, t: int, arrival: Arrival, new: NewObject | None, config: Config, progress
) -> tuple[State, Account | None]:
    """The state with a new template; ground that something had hidden joins the background instead."""
    if new is None:
        return state, None
    if not _explains(new, config):
        gains = f"{new.gain:.2f} of it, {new.own_gain:.2f} within its outlines"
        progress.note(f"visit {t}: a change left out, as a new object it explains {gains}")
        return state, None
    doubt, splats = 0.5 * config.detect.guessed, new.template.splats
    views = arrival.instance.views
    height = arrival.support.height(np.asarray(splats.means, np.float64))
    bared = arrival.bared > _BARED
    firm = splats[new.firm]
    ground, shade = _ground(state, t, arrival, firm)
    if ground or (ground is None and bared):
        if shade < 1 and not bared:
            progress.note(f"visit {t}: a shadow in {views} photographs, left out")
            return state, None
        progress.note(f"visit {t}: ground that was hidden or in shadow before, from {views} photographs")
        flat = height < _LOW * template_diameter(splats)  # what floats above it is no ground
        return _with_ground(state, t, splats[flat], doubt), None
    low = height < _LOW * template_diameter(firm)
    state = _with_ground(state, t, splats[~new.firm & low], doubt)
    whole = _part_of(state, t, firm)
    if whole is not None:
        progress.note(f"visit {t}: more of object {state.chronology.templates[whole].identity}, not seen before")
        pose = state.chronology.world_from_template[t, whole]
        piece = on_host(transform_splats(pose.inverse(), firm))
        return extend_template(state, whole, piece, np.full(piece.count, doubt, state.errors.dtype)), None
    if not _stands(state, t, firm, arrival.support):
        progress.note(f"visit {t}: a change in {views} photographs that floats, or clings to what is there, left out")
        return state, None
    errors = np.full(firm.count, doubt, state.errors.dtype)
    template = Template(firm, next_identity(state), t)
    state = add_template(state, template, errors, arrival.support, t)
    return state, Account(len(state.chronology.templates) - 1, "added", new.gain, new.error, views)


def _explains(new: NewObject, config: Config) -> bool:
    """Whether a new object explains as much of the change as it must, and no more than there is."""
    return new.gain >= config.template.tau_new and new.own_gain <= _MOST


def _ground(state: State, t: int, arrival: Arrival, firm: Splats) -> tuple[bool | None, float]:
    """Whether what came, its firm splats as a new object, is the ground itself (None: unknown), and its brightness over
    that of the ground around it."""
    if arrival.light is not None:
        return True, arrival.light
    unshaded = _left_beside(state, t, np.asarray(firm.means, np.float64))
    known = state.chronology.background
    return ground_shade(firm, arrival.support, known, bared=arrival.bared, unshaded=unshaded)


def _left_beside(state: State, t: int, points: Float[np.ndarray, "n 3"]) -> bool:
    """Whether something stood so close to points, before visit t and not any more, that its shadow may have lain
    there."""
    middle = np.median(points, axis=0) if len(points) else np.full(3, np.inf)
    visible = np.asarray(state.chronology.visible)
    for k, template in enumerate(state.chronology.templates):
        reach, places = _SHADE_LENGTH * template_diameter(template.splats), middles_of(state, k)
        for s in np.flatnonzero(visible[:t, k]):
            gone = not visible[t, k] or np.linalg.norm(places[s] - places[t]) > 0.5 * reach
            if gone and np.linalg.norm(places[s] - middle) < reach:
                return True
    return False


def _shown(state: State, t: int, k: int, observations, *, eye: Eye) -> float:
    """Share of the pixels which a template shows in alone that show it in the scene, in the middle of the views."""
    scene = scene_at(state, t)
    splats, errors, owner, _ = scene
    mine = owner == k + 1
    alone = [eye.look(splats[mine], o.camera, errors[mine]).alpha > 0.5 for o in observations]
    cover = eye.cover(scene, [k], observations)
    shares = [(c & a).sum() / a.sum() for c, a in zip(cover, alone, strict=True) if a.any()]
    return float(np.median(shares)) if shares else 0.0


def _with_ground(state: State, t: int, splats: Splats, doubt: float) -> State:
    return extend_background(state, splats, np.full(splats.count, doubt), np.zeros(splats.count, bool), t)


def _stands(state: State, t: int, piece: Splats, support: Support) -> bool:
    """Whether a piece is a thing on its surface: it neither floats, nor lies all along what stands there, as the shade
    on that does, or a side of it that was badly seen."""
    size = template_diameter(piece)
    if np.quantile(support.height(np.asarray(piece.means, np.float64)), 0.05) > _FLOATS * size:
        return False

    def above(splats: Splats) -> Float[np.ndarray, "n 3"]:
        means = np.asarray(splats.means, np.float64)
        return means[(np.asarray(splats.opacities) > 0.3) & (support.height(means) > _LOW * size)]

    body, standing = above(piece), above(scene_at(state, t)[0])
    if len(body) < _FLAT * piece.count or not len(standing):
        return True
    return float(np.median(cKDTree(standing).query(body)[0])) > _CLINGS * size


def _part_of(state: State, t: int, piece: Splats) -> int | None:
    """The template, away from where the first visit saw it, that a smaller piece against it completes."""
    means = np.asarray(piece.means)
    for k, template in enumerate(state.chronology.templates):
        pose = state.chronology.world_from_template[t, k]
        first = template.source_visit == 0 and np.abs(np.asarray(pose.xyz)).max() == 0
        if first or not bool(state.chronology.visible[t, k]):
            continue
        size = template_diameter(template.splats)
        whole = np.asarray(pose.apply(jnp.asarray(template.splats.means)))
        near = cKDTree(whole).query(means)[0]
        if np.quantile(near, 0.75) < 0.15 * size and template_diameter(piece) < size:
            return k
    return None


def _settle_new(
    template: Template, crop: Crop, config: Config
) -> tuple[Template, Float[np.ndarray, "v s s 3"], float, float]:
    """A new object after a short fit in its windows, those with it, what is left unlike the photographs, and the share
    of the change that it explains; splats that the photographs do not support fade and are dropped."""
    size = template_diameter(template.splats)
    padded = pad_splats(template.splats, config.template.new_splats)
    windows = Windows(crop.camera, crop.target, crop.backdrop, crop.depth, crop.valid)
    splats, _, images = fit_local(padded, windows, size=size, steps=config.template.new_steps)
    error, gain = explained(images, crop)
    splats = splats[: template.splats.count]
    keep = np.asarray(splats.opacities) > 0.02
    if keep.sum() < 8:
        return template, images, error, 0.0
    return eqx.tree_at(lambda m: m.splats, template, splats[keep]), images, error, gain


def _places(points: Float[np.ndarray, "n 3"], size: float) -> Float[np.ndarray, "p 3"]:
    """Where in an arrival's volume an object of this size may stand: in its middle, or, where there is room for more
    than one such thing, in each part of it."""
    middle = np.median(points, axis=0)[None]
    low, high = np.quantile(points, [0.02, 0.98], axis=0)
    if np.linalg.norm(high - low) < _ROOM * size:
        return middle
    parts, _ = kmeans2(points[:: max(1, len(points) // 2000)], 3, minit="++", seed=0)
    return np.concatenate([middle, parts])


def _sizes_agree(instance: Instance, size: float) -> bool:
    """Whether an instance's volume could hold a template: hulls of few views are larger, never much smaller."""
    low, high = np.quantile(instance.points, [0.02, 0.98], axis=0)
    return 0.5 * size < np.linalg.norm(high - low) < 6 * size
