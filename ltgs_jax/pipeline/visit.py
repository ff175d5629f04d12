"""One visit: what its photographs show that the scene does not, explained by the cheapest account they support."""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree

from ltgs_jax.detect import ChangeMap, change_map, dilate
from ltgs_jax.features import FrontEnd
from ltgs_jax.fit import Windows, fit_local, template_diameter
from ltgs_jax.geometry import SE3
from ltgs_jax.match import Instance, find_instances
from ltgs_jax.scene import Chronology, Splats, Template, compose, concatenate_splats
from ltgs_jax.template import (
    Crop,
    Support,
    backdrop_error,
    build_template,
    color_from_photographs,
    fill_under,
    find_removed,
    gone_evidence,
    make_crop,
    search_template,
    settle_template,
    support_below,
)

from .config import Config
from .looks import Eye, Look, Observation, cone_of, on_host, pad_splats, projection_of


class State(eqx.Module):
    """The chronology so far, and what the stages know beside it.

    `errors` expected dissimilarity of each background splat, `template_errors` of each template's; `supports` the
    surface that each template stood on where its frame is.
    """

    chronology: Chronology
    errors: Float[np.ndarray, " n"]
    template_errors: tuple[Float[np.ndarray, " m"], ...]
    supports: tuple[Support | None, ...]


class Account(eqx.Module):
    """How one object was explained at one visit: kind, share of the error explained, and over how many photographs."""

    template: int = eqx.field(static=True)
    kind: str = eqx.field(static=True)
    gain: float = eqx.field(static=True)
    residual: float = eqx.field(static=True)
    views: int = eqx.field(static=True)


_compose = eqx.filter_jit(compose)  # eagerly, every template's new shape would compile every operation anew


def _scene(state: State, t: int) -> tuple[Splats, np.ndarray, np.ndarray]:
    """The scene at visit t with hidden templates left out: splats, expected errors, owner (0 background, 1 + k)."""
    splats = on_host(_compose(state.chronology, jnp.asarray(t)))
    errors = np.concatenate([state.errors, *state.template_errors])
    counts = [state.chronology.background.count, *[m.splats.count for m in state.chronology.templates]]
    owner = np.repeat(np.arange(len(counts)), counts)
    keep = np.asarray(splats.logit_opacities) > -np.inf
    return splats[keep], errors[keep], owner[keep]


def _set_from(state: State, t: int, k: int, *, visible: bool, pose: SE3 | None = None, unsure: float = 0.0) -> State:
    """Template k from visit t on: whether it is there, and where."""
    chronology = state.chronology
    flags = np.array(chronology.visible)
    flags[t:, k] = visible
    poses = chronology.world_from_template
    if pose is not None:
        # Sides and edges that the first pose never showed: only a strong difference there is a change.
        state = eqx.tree_at(lambda s: s.template_errors[k], state, np.maximum(state.template_errors[k], unsure))
        quat, xyz = np.array(poses.quat), np.array(poses.xyz)
        quat[t:, k], xyz[t:, k] = np.asarray(pose.quat), np.asarray(pose.xyz)
        poses = SE3(quat, xyz)
    chronology = eqx.tree_at(lambda c: (c.visible, c.world_from_template), chronology, (flags, poses))
    return eqx.tree_at(lambda s: s.chronology, state, chronology)


def _add_template(state: State, template: Template, errors: np.ndarray, support: Support | None, first: int) -> State:
    """A new template, at its own frame's pose, visible from visit `first` on."""
    chronology = state.chronology
    visits = chronology.visible.shape[0]
    identity = SE3.identity((visits, 1), jnp.float32)
    poses = jax.tree.map(lambda a, b: np.concatenate([a, b], axis=1), chronology.world_from_template, identity)
    column = (np.arange(visits) >= first)[:, None]
    template = eqx.tree_at(lambda m: m.splats, template, on_host(template.splats))
    chronology = Chronology(
        chronology.background,
        (*chronology.templates, template),
        poses,
        np.concatenate([chronology.visible, column], axis=1),
        chronology.exposure,
        chronology.visits,
        chronology.photographs,
    )
    return State(chronology, state.errors, (*state.template_errors, errors), (*state.supports, support))


def _with_background(state: State, background: Splats, errors: np.ndarray) -> State:
    return eqx.tree_at(lambda s: (s.chronology.background, s.errors), state, (background, errors))


def _extend_template(state: State, k: int, splats: Splats, errors: np.ndarray) -> State:
    """More splats, in world coordinates, for a template whose frame is the world's."""
    joined = concatenate_splats([state.chronology.templates[k].splats, splats])
    return eqx.tree_at(
        lambda s: (s.chronology.templates[k].splats, s.template_errors[k]),
        state,
        (on_host(joined), np.concatenate([state.template_errors[k], errors])),
    )


class _Evidence(eqx.Module):
    """Looks at the scene, and what every photograph says of change."""

    looks: tuple[Look, ...]
    changes: tuple[ChangeMap, ...]

    @property
    def masks(self) -> list[Bool[np.ndarray, "h w"]]:
        """The pixels of each photograph that changed."""
        return [change.mask for change in self.changes]


def _compare(eye: Eye, splats, errors, observations: Sequence[Observation], front_end, config: Config) -> _Evidence:
    looks = [eye.look(splats, o.camera, errors) for o in observations]
    changes = [
        change_map(look.image, o.image, look.expected, o.valid, front_end, config=config.detect)
        for look, o in zip(looks, observations, strict=True)
    ]
    return _Evidence(tuple(looks), tuple(changes))


def explain_visit(
    state: State,
    t: int,
    observations: Sequence[Observation],
    front_end: FrontEnd,
    *,
    eye: Eye,
    config: Config,
    rng: np.random.Generator,
    progress,
) -> tuple[State, list[Account], list[Bool[np.ndarray, "h w"]]]:
    """The state after visit t, how each object was explained, and the coarse change masks.

    First what left: splats whose every view changed. Then, with that taken out and the ground under it filled, what
    came: outlines that meet in space. Each arrival is a known template at a new pose if one explains the photographs,
    else a new object.
    """
    splats, errors, owner = _scene(state, t)
    before = _compare(eye, splats, errors, observations, front_end, config)
    coarse = before.masks
    if not any(mask.any() for mask in coarse):
        return state, [], coarse
    after, gone = before, {}
    # Twice: with the bulk of an object gone, what the first cut left of it stands out.
    for _ in range(2):
        background = state.chronology.background
        state, gone = _take_out(state, t, gone, splats, owner, observations, after, eye, config, rng)
        splats, errors, owner = _scene(state, t)
        after = _compare(eye, splats, errors, observations, front_end, config)
        if state.chronology.background is background:
            break
    silhouettes = [
        dilate(mask, config.detect.dilate) & o.valid for mask, o in zip(after.masks, observations, strict=True)
    ]
    cones = [
        cone_of(o.camera, s, o.valid, look) for o, s, look in zip(observations, silhouettes, after.looks, strict=True)
    ]
    solid = np.asarray(splats.opacities) > 0.3
    surface = np.asarray(splats.means, np.float64)[solid]
    instances = find_instances(cones, surface, config=config.match)
    progress.note(f"visit {t}: {len(gone)} left their place, {len(instances)} came")
    state, accounts = _place(state, t, gone, instances, cones, observations, after, surface, eye, config, rng, progress)
    placed = {a.template for a in accounts}
    accounts += [Account(k, "removed", gone[k], 0.0, len(observations)) for k in gone if k not in placed]
    return state, accounts, coarse


def _take_out(state: State, t: int, gone, splats, owner, observations, evidence: _Evidence, eye: Eye, config, rng):
    """Hide the templates and cut out the background objects that the photographs say have left.

    `gone`: what left before in this visit, by template: the share of its evidence that says so. A remnant of one of
    these joins it.
    """
    gone = dict(gone)
    votes = [
        eye.votes(splats, o.camera, np.stack([o.valid, change.evidence * o.valid], axis=-1))
        for o, change in zip(observations, evidence.changes, strict=True)
    ]
    seen, told = np.stack([v[:, 0] for v in votes]), np.stack([v[:, 1] for v in votes])
    pixels = int(np.mean([o.valid.size for o in observations]))
    cameras = np.stack([np.asarray(o.camera.center(), np.float64) for o in observations])
    for k in range(len(state.chronology.templates)):
        mine = owner == k + 1
        left, stayed = gone_evidence(seen[:, mine], told[:, mine])
        if left.sum() > max(stayed.sum(), config.template.min_pixels * pixels):
            gone[k] = float(left.sum() / (left.sum() + stayed.sum()))
            state = _set_from(state, t, k, visible=False)
    base = owner == 0
    background = state.chronology.background
    removals = find_removed(
        splats[base], seen[:, base], told[:, base], cameras, pixels=pixels, rng=rng, config=config.template
    )
    taken = np.zeros(background.count, bool)
    fills = []
    for removal in removals:
        members = removal.members & ~taken
        if members.sum() < 8:
            continue
        taken |= members
        k = _torn_from(state, background[members], gone, t)
        if k is None:
            identity = 1 + max([m.identity for m in state.chronology.templates], default=0)
            template = Template(background[members], identity, 0)
            state = _add_template(state, template, state.errors[members], removal.support, 0)
            k = len(state.chronology.templates) - 1
            state = _set_from(state, t, k, visible=False)
        else:
            state = _extend_template(state, k, background[members], state.errors[members])
        mine = np.flatnonzero(base)[members]
        left, stayed = gone_evidence(seen[:, mine], told[:, mine])
        gone[k] = float(left.sum() / (left.sum() + stayed.sum()))
        if removal.support is not None:
            points = np.asarray(background.means, np.float64)[members]
            fills.append((points, removal.support))
    if taken.any():
        rest = background[~taken]
        errors = state.errors[~taken]
        new = [on_host(fill_under(rest, points, support, config=config.template)) for points, support in fills]
        added = sum(part.count for part in new)
        guess = np.full(added, config.detect.guessed, errors.dtype)
        if added:
            projections = [projection_of(o.camera) for o in observations]
            ground, seen_there = color_from_photographs(
                concatenate_splats(new), projections, [o.image for o in observations]
            )
            new = [on_host(ground)]
            guess[seen_there] = 0.5 * config.detect.guessed
        # Its colours are guesses: only a strong difference there says that something came.
        state = _with_background(state, concatenate_splats([rest, *new]), np.concatenate([errors, guess]))
    return state, gone


def _torn_from(state: State, piece: Splats, gone, t: int) -> int | None:
    """The template, cut out at this visit, that a smaller piece beside it belongs to."""
    means = np.asarray(piece.means)
    for k in gone:
        template = state.chronology.templates[k]
        if template.source_visit != 0 or bool(np.asarray(state.chronology.visible)[t:, k].any()):
            continue
        pose = state.chronology.world_from_template[t, k]
        if np.abs(np.asarray(pose.xyz)).max() > 0 or piece.count > template.splats.count:
            continue
        size = template_diameter(template.splats)
        distance = cKDTree(np.asarray(template.splats.means)).query(means)[0]
        if np.median(distance) < 0.2 * size and np.linalg.norm(np.ptp(means, axis=0)) < size:
            return k
    return None


def _window(instance: Instance, observations, extra: Sequence[np.ndarray] = ()) -> list[tuple[float, float, float]]:
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


def _place(state, t, gone, instances, cones, observations, evidence, surface, eye: Eye, config: Config, rng, progress):
    """Known templates for what came, by photometric evidence and one assignment; new objects for the rest."""
    cameras = np.stack([np.asarray(o.camera.center(), np.float64) for o in observations])
    weights = np.ones(len(surface))
    hidden = [k for k in range(len(state.chronology.templates)) if not bool(state.chronology.visible[t, k])]
    supports, placements, crops = [], {}, {}
    for i, instance in enumerate(instances):
        support = support_below(instance, surface, weights, cameras, rng=rng)
        supports.append(support)
        if support is None:
            continue
        boxes = _window(instance, observations)
        crops[i] = crop = make_crop(
            [o.camera for o in observations],
            [o.image for o in observations],
            [look.image for look in evidence.looks],
            [look.depth for look in evidence.looks],
            # Pixels that other arrivals changed say nothing about this one.
            [
                o.valid & (dilate(region, 2) | ~dilate(mask, 2))
                for o, region, mask in zip(observations, instance.regions, evidence.masks, strict=True)
            ],
            [dilate(region, 2) & o.valid for o, region in zip(observations, instance.regions, strict=True)],
            boxes,
            size=config.template.window,
        )
        searches = {}
        for k in hidden:
            stood_on, template = state.supports[k], state.chronology.templates[k]
            size = template_diameter(template.splats)
            if stood_on is not None and _sizes_agree(instance, size):
                place = np.median(instance.points, axis=0)
                searches[k] = search_template(
                    template,
                    stood_on,
                    support,
                    place,
                    crop,
                    size=size,
                    refiner=eye.refiner,
                    rng=rng,
                    before=state.chronology.world_from_template[t - 1, k],
                    config=config.template,
                )
        for k in sorted(searches, key=lambda k: -searches[k].best_gain)[: config.template.candidates]:
            template = state.chronology.templates[k]
            placement = settle_template(
                searches[k], crop, size=template_diameter(template.splats), refiner=eye.refiner
            )
            progress.note(
                f"visit {t}: arrival {i} as object {template.identity}: explains {placement.gain:.2f}, "
                f"overlaps {placement.overlap:.2f} "
                f"(search {searches[k].best_gain:.2f})"
            )
            placements[i, k] = placement
    cost = np.zeros((len(instances), len(hidden) + len(instances)))
    for (i, k), placement in placements.items():
        if placement.gain > config.template.tau_gain and placement.overlap > config.template.tau_outline:
            cost[i, hidden.index(k)] = -placement.gain * placement.overlap
    accounts = []
    rows, columns = linear_sum_assignment(cost) if len(instances) else ([], [])
    for i, column in zip(rows, columns, strict=True):
        instance = instances[i]
        if column < len(hidden) and cost[i, column] < 0:
            k = hidden[column]
            placement = placements[i, k]
            state = _set_from(
                state,
                t,
                k,
                visible=True,
                pose=placement.world_from_template,
                unsure=0.5 * config.detect.guessed,
            )
            kind = "moved" if k in gone else "added"
            accounts.append(Account(k, kind, placement.gain, placement.error, instance.views))
            continue
        identity = 1 + max([m.identity for m in state.chronology.templates], default=0)
        template = build_template(
            instance,
            supports[i],
            cones,
            [o.image for o in observations],
            identity=identity,
            visit=t,
            coefficients=state.chronology.background.sh.shape[1],
            rng=rng,
            config=config.template,
        )
        if template is None:
            continue
        if i not in crops:
            continue
        template, gain = _settle_new(template, crops[i], config)
        # More than the change itself: it improves what did not change, and is no account of what did.
        if not config.template.tau_new <= gain <= 1.3:
            progress.note(f"visit {t}: arrival {i} left out, as an object it explains {gain:.2f} of the change")
            continue
        errors = np.full(template.splats.count, 0.5 * config.detect.guessed, state.errors.dtype)
        state = _add_template(state, template, errors, supports[i], t)
        accounts.append(Account(len(state.chronology.templates) - 1, "added", gain, 0.0, instance.views))
    return state, accounts


def _settle_new(template: Template, crop: Crop, config: Config) -> tuple[Template, float]:
    """A new object after a short fit in its windows, and the share of the change that it explains; what the photographs
    do not support fades and is dropped. A change too faint to be an object explains nothing."""
    size = template_diameter(template.splats)
    padded = pad_splats(template.splats, multiple=config.template.new_splats)
    windows = Windows(crop.camera, crop.target, crop.backdrop, crop.depth, crop.valid)
    splats, losses = fit_local(padded, windows, size=size, steps=config.template.new_steps)
    splats = splats[: template.splats.count]
    keep = np.asarray(splats.opacities) > 0.02
    without, change = backdrop_error(crop)
    strength = change / max(float(np.mean(np.asarray(crop.region & crop.valid))), 1e-6)
    if keep.sum() < 8 or strength < config.template.faint:
        return template, 0.0
    gain = (without - float(losses[-5:].mean())) / max(change, 1e-9)
    return eqx.tree_at(lambda m: m.splats, template, splats[keep]), gain


def _sizes_agree(instance: Instance, size: float) -> bool:
    """Whether an instance's volume could hold a template: hulls of few views are larger, never much smaller."""
    low, high = np.quantile(instance.points, [0.02, 0.98], axis=0)
    return 0.5 * size < np.linalg.norm(high - low) < 6 * size
