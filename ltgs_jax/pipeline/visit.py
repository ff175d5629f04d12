"""One visit: what its photographs show that the scene does not, explained by the cheapest account they support."""

import dataclasses
from collections.abc import Callable, Sequence

import equinox as eqx
import numpy as np
from jaxtyping import Bool

from ltgs_jax.detect import dilate, similarity
from ltgs_jax.features import FrontEnd
from ltgs_jax.match import Instance, find_instances
from ltgs_jax.scene import Template

from .arrivals import place_arrivals
from .config import Config
from .departures import Remnant, take_out
from .in_place import turn_in_place
from .looks import Evidence, Eye, Observation, compare, cone_of, unlike_where_different
from .reshaped import join_states
from .state import (
    Account,
    State,
    add_template,
    doubt_template,
    drop_template,
    extend_background,
    extend_template,
    next_identity,
    scene_at,
    set_from,
)

_LEAST_SHOWN = 6  # times the least evidence for an object, dilated outlines included, below which nothing is seen of it


class Explained(eqx.Module):
    """What one visit came to: the state after it, how each object was explained, the coarse change masks of the
    photographs that were used, and the names of those that differ from the scene all over, which were not."""

    state: State
    accounts: list[Account]
    masks: list[Bool[np.ndarray, "h w"]]
    unlike: list[str]


def explain_visit(
    state: State,
    t: int,
    observations: Sequence[Observation],
    front_end: FrontEnd,
    *,
    earlier: Callable[[int], Sequence[Observation]],
    eye: Eye,
    config: Config,
    rng: np.random.Generator,
    progress,
) -> Explained:
    """The visit's objects, each by the cheapest account that its photographs support.

    `earlier` gives the photographs of a visit before, should its poses come into question.

    First what left: splats whose every view changed. Then, with that taken out and the ground under it filled, what
    came: outlines that meet in space. Each arrival is a known template at a new pose if one explains the photographs,
    else a new object. Last, what left is put back where the photographs like that as well, and what came in the place
    of something that left, with its colours, is that in a new state.
    """
    known = len(state.chronology.templates)
    scene = scene_at(state, t)
    evidence = compare(eye, scene, observations, front_end, config)
    kept = [i for i, change in enumerate(evidence.changes) if not change.everywhere]
    unlike = [o.name for i, o in enumerate(observations) if i not in kept]
    observations = [observations[i] for i in kept]
    evidence = Evidence(tuple(evidence.looks[i] for i in kept), tuple(evidence.changes[i] for i in kept))
    coarse = evidence.masks
    if not any(mask.any() for mask in coarse):
        return Explained(state, [], coarse, unlike)
    gone: dict[int, float] = {}
    remnants: list[Remnant] = []
    # Twice: with the bulk of an object gone, what the first cut left of it stands out.
    for _ in range(2):
        before = state
        state, gone, torn = take_out(state, t, gone, scene, observations, evidence, eye=eye, config=config, rng=rng)
        remnants += torn
        if state is before:
            break
        scene = scene_at(state, t)
        evidence = compare(eye, scene, observations, front_end, config)
        if state.chronology.background is before.chronology.background:
            break
    tools = {"eye": eye, "config": config, "rng": rng, "progress": progress}
    state, turned, stood, evidence = turn_in_place(
        state, t, gone, observations, evidence, front_end, earlier=earlier, **tools
    )
    gone = {k: share for k, share in gone.items() if k not in stood}
    scene = scene_at(state, t)
    silhouettes = [
        dilate(mask, config.detect.dilate) & o.valid for mask, o in zip(evidence.masks, observations, strict=True)
    ]
    cones = [
        cone_of(o.camera, s, o.valid, look)
        for o, s, look in zip(observations, silhouettes, evidence.looks, strict=True)
    ]
    splats, _, _, guessed = scene
    surface = np.asarray(splats.means, np.float64)[np.asarray(splats.opacities) > 0.3]
    guesses = [eye.paint(splats, o.camera, guessed[:, None])[..., 0] > 0.5 for o in observations]
    left = eye.cover(scene_at(state, t - 1), sorted(gone), observations)
    bared = [dilate(c, config.detect.dilate) | g for c, g in zip(left, guesses, strict=True)]
    instances = [
        instance
        for instance in find_instances(cones, surface, config=config.match)
        if instance.views > 1 or _strength(instance, evidence) > config.detect.alone
    ]
    progress.note(f"visit {t}: {len(gone)} left their place, {len(turned) + len(instances)} came")
    state, accounts = place_arrivals(
        state, t, gone, instances, observations, evidence, bared, surface, front_end, **tools
    )
    accounts += turned
    unsettled = sorted(set(gone) - {a.template for a in turned})
    state, accounts = _put_back(
        state, t, unsettled, remnants, accounts, known, observations, eye=eye, config=config, progress=progress
    )
    state, accounts = join_states(state, t, accounts)
    state = _learn_errors(state, t, accounts, observations, front_end, eye, config)
    return Explained(state, accounts, coarse, unlike)


def _strength(instance: Instance, evidence: Evidence) -> float:
    """Mean score of the pixels that changed within an instance's outlines."""
    pixels = [
        change.score[region & change.mask] for change, region in zip(evidence.changes, instance.regions, strict=True)
    ]
    return float(np.mean(np.concatenate([*pixels, np.zeros(1)])))


def _put_back(
    state: State, t: int, gone: Sequence[int], remnants: Sequence[Remnant], accounts: list[Account], known: int,
    observations, *, eye, config, progress,
) -> tuple[State, list[Account]]:  # fmt: skip
    """What left stays after all where the photographs like the scene with it as well: still is cheaper than moved.

    Something cut out of the background at this visit (`known` and later) goes back into it.
    """
    final = {a.template: a for a in accounts}
    images = [eye.image(scene_at(state, t)[0], o.camera) for o in observations]

    def judged(alternative: State):
        others = [eye.image(scene_at(alternative, t)[0], o.camera) for o in observations]
        left, stayed, shown = unlike_where_different(images, others, observations)
        # What hardly shows either way, under something that came, gives no account of itself.
        hidden = shown < _LEAST_SHOWN * config.template.min_pixels
        return stayed <= left * (1 + config.template.still_margin), hidden, left, stayed, others

    back = []
    for k in gone:
        alternative = set_from(state, t, k, visible=True, pose=state.chronology.world_from_template[t - 1, k])
        as_good, hidden, left, stayed, others = judged(alternative)
        if as_good or hidden:
            told = f"unlikeness {stayed:.3f} there, {left:.3f} without"
            told += "" if as_good else ", too little shows of it to tell"
            progress.note(f"visit {t}: object {state.chronology.templates[k].identity} stays where it was ({told})")
            state, images = alternative, others
            final.pop(k, None)
            back.append(k)
        elif k not in final:
            final[k] = Account(k, "removed", 1 - left / max(stayed, 1e-9), left, len(observations))
    for remnant in remnants:
        alternative = extend_background(state, remnant.splats, remnant.errors, np.zeros(len(remnant.errors), bool), 0)
        as_good, hidden, left, stayed, others = judged(alternative)
        if as_good or hidden:
            state, images = alternative, others
        elif remnant.whole not in back:
            state = extend_template(state, remnant.whole, remnant.splats, remnant.errors)
        else:
            support = state.supports[remnant.whole]
            state = add_template(state, Template(remnant.splats, next_identity(state), 0), remnant.errors, support, 0)
            k = len(state.chronology.templates) - 1
            state = set_from(state, t, k, visible=False)
            final[k] = Account(k, "removed", 1 - left / max(stayed, 1e-9), left, len(observations))
    for k in reversed([k for k in back if k >= known and not state.chronology.world_from_template[t, k].xyz.any()]):
        template, errors = state.chronology.templates[k], state.template_errors[k]
        state = extend_background(drop_template(state, k), template.splats, errors, np.zeros(len(errors), bool), 0)
        final = {
            a.template: a
            for a in (dataclasses.replace(a, template=a.template - (a.template > k)) for a in final.values())
        }
    return state, [final[k] for k in sorted(final)]


def _learn_errors(
    state: State, t: int, accounts: Sequence[Account], observations, front_end: FrontEnd, eye: Eye, config: Config
) -> State:
    """What the templates that moved or came leave unexplained in this visit's photographs is to be expected of them."""
    placed = [a for a in accounts if a.kind in ("moved", "added", "new_state")]
    if not placed:
        return state
    splats, _, owner, _ = scene_at(state, t)
    votes = np.zeros((splats.count, 2))
    for o in observations:
        unlike = 1 - similarity(eye.image(splats, o.camera), o.image, front_end, gamma=config.detect.gamma)
        votes += eye.votes(splats, o.camera, np.stack([unlike * o.valid, o.valid], axis=-1))
    for account in placed:
        mine = votes[owner == account.template + 1]
        usual = mine[:, 0].sum() / max(mine[:, 1].sum(), 1e-9)
        learned = (mine[:, 0] + usual) / (mine[:, 1] + 1)
        state = doubt_template(state, account.template, np.where(mine[:, 1] > 0.3, learned, 0.0))
    return state
