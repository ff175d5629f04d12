"""What changed and stands where it stood: turned or nudged, or put at the wrong pose by a visit before."""

from collections.abc import Callable, Sequence

import jax.numpy as jnp
import numpy as np

from ltgs_jax.detect import dilate
from ltgs_jax.features import FrontEnd
from ltgs_jax.fit import template_diameter
from ltgs_jax.geometry import SE3, rotation_angle
from ltgs_jax.match import Instance
from ltgs_jax.scene import Template
from ltgs_jax.template import middle_of, nudged, place_template, search_template, settle_template

from .arrivals import convincing, crop_around
from .config import Config
from .looks import Evidence, Eye, Observation, compare, still_changed, unlike_where_different
from .matched import SIDE, Matcher
from .state import Account, State, came_to_place, scene_at, set_from

_PARTLY = 0.06  # pixels that changed on and beside an object, per pixel of it, for it to be looked for at another turn
_OFF = 1.0  # mean score, in deviations, of an object's pixels, too little for each, from which on the whole is doubted
_BESIDE = 0.15  # width of what is beside it, in sides of a square as large
_OF_FEW = 2.0  # times the margin by which a turn must look better, of what a few photographs of a later visit made
_TURNED, _SHIFTED = np.radians(3), 0.03  # from where it stood, in radians and sizes, up to which a pose is the same


def turn_in_place(
    state: State,
    t: int,
    gone: dict[int, float],
    observations: Sequence[Observation],
    evidence: Evidence,
    front_end: FrontEnd,
    *,
    earlier: Callable[[int], Sequence[Observation]],
    eye: Eye,
    config: Config,
    rng: np.random.Generator,
    progress,
) -> tuple[State, list[Account], list[int], Evidence]:
    """What seemed to leave, or changed in part, and stands where it stood, turned or nudged: looked for there before
    anything else, since colours that happen to agree leave only pieces of such a change.

    An account of each; the templates that did not move at all: the photographs of the visit that put them there
    (`earlier`) like the pose found now as well, which is theirs from that visit on; and the evidence against the scene
    that it leaves, `evidence` itself where nothing was turned.
    """
    accounts, stood, after = [], [], evidence
    matcher = Matcher(state, front_end, config)
    first = state
    for k, cover in _turned_candidates(state, t, gone, observations, evidence, eye=eye):
        support, template = state.supports[k], state.chronology.templates[k]
        if support is None:
            continue
        before = state.chronology.world_from_template[t - 1, k]
        # Without it, whether it seemed to leave or not: its place has to be explained anew.
        hidden, without = state, evidence
        if k not in gone:
            hidden = set_from(state, t, k, visible=False)
            without = compare(eye, scene_at(hidden, t), observations, front_end, config)
        if cover is None or state is not first:
            shown = scene_at(set_from(hidden, t, k, visible=True, pose=before), t)
            cover = eye.cover(shown, [k], observations)
        regions = [dilate(c, 4) & m for c, m in zip(cover, without.masks, strict=True)]
        views = sum(bool((c & m).sum() > 0.5 * c.sum() > 0) for c, m in zip(cover, without.masks, strict=True))
        if views == 0:
            continue
        points = np.asarray(before.apply(jnp.asarray(template.splats.means)), np.float64)
        instance = Instance(points, tuple(regions), views)
        crop, window = (crop_around(instance, observations, without, s) for s in (config.template.window, SIDE))
        size = template_diameter(template.splats)
        search = search_template(
            template, support, support.moved(before), middle_of(points)[None], crop,
            size=size, refiner=eye.refiner, rng=rng, before=before, matched=matcher.poses(k, window, instance),
            config=config.template,
        )  # fmt: skip
        if search.best_gain < config.template.tau_gain:
            continue
        found = settle_template(search, crop, size=size, refiner=eye.refiner)
        pose, looks = found.world_from_template, {"size": size, "refiner": eye.refiner}
        # Another turn is compared with the best pose about as it stood; that with the very pose.
        about = nudged(search, before, crop, **looks)
        rival = about if _elsewhere(pose, about, template, size) else before
        # Lit alike: the shade in its splats turns with it, and that of the room does not.
        turned, still = (place_template(search, p, crop, lit=True, **looks) for p in (pose, rival))
        progress.note(
            f"visit {t}: object {template.identity} turned or nudged explains {found.gain:.2f}, outline "
            f"{found.overlap:.2f}, likeness {found.likeness:.2f}, recall {found.recall:.2f}, unlikeness, lit, "
            f"{turned.error:.3f}; as it stood {still.error:.3f}"
        )
        margin = config.template.still_margin * (_OF_FEW if template.source_visit > 0 else 1)
        if not convincing(found, config) or turned.error > still.error * (1 - margin):
            continue
        if not _elsewhere(pose, before, template, size):
            continue
        trial = set_from(hidden, t, k, visible=True, pose=pose, unsure=config.detect.moved)
        turned_scene = scene_at(trial, t)
        with_it = compare(eye, turned_scene, observations, front_end, config)
        if still_changed(turned_scene, k, observations, without, with_it, eye=eye) > config.template.tau_remains:
            continue
        after = with_it
        since = came_to_place(state, t - 1, k)
        if since > 0 and _stood_so(state, since, k, pose, earlier(since), eye=eye, config=config):
            progress.note(
                f"visit {t}: object {template.identity} did not move: visit {since} likes its pose of now too"
            )
            state = set_from(state, since, k, visible=True, pose=pose, unsure=config.detect.moved)
            stood.append(k)
            continue
        state = set_from(state, t, k, visible=True, pose=pose, unsure=config.detect.moved)
        progress.note(f"visit {t}: object {template.identity} stands where it stood, turned or nudged")
        accounts.append(Account.of_placed(k, "moved", found, views))
    return state, accounts, stood, after


def _stood_so(
    state: State, t: int, k: int, pose: SE3, observations: Sequence[Observation], *, eye: Eye, config: Config
) -> bool:
    """Whether the photographs of visit t like template k at another pose as well as at its own: one pose for two visits
    is cheaper than two."""
    scenes = (scene_at(s, t)[0] for s in (state, set_from(state, t, k, visible=True, pose=pose)))
    images, others = ([eye.image(splats, o.camera) for o in observations] for splats in scenes)
    own, other, _ = unlike_where_different(images, others, observations)
    return other <= own * (1 + config.template.still_margin)


def _turned_candidates(state: State, t: int, gone: dict[int, float], observations, evidence: Evidence, *, eye: Eye):
    """Templates, each with the pixels that it covers where it shows: those that seemed to leave, those on or beside
    which two photographs or more show that a part changed, and those that look a little otherwise than expected all
    over: what moved before is expected to look worse, and a turn that every pixel lets pass is told by all of them."""
    shown = [k for k in np.flatnonzero(np.asarray(state.chronology.visible)[t]).tolist() if k not in gone]
    covers = dict(zip(shown, eye.covers(scene_at(state, t), [[k] for k in shown], observations), strict=True))
    for k in range(len(state.chronology.templates)):
        if k in gone:
            yield k, None
        elif k in covers:
            cover = covers[k]
            areas = [max(c.sum(), 1) for c in cover]
            near = [dilate(c, max(1, round(_BESIDE * area**0.5))) for c, area in zip(cover, areas, strict=True)]
            changed = [(n & m).sum() for n, m in zip(near, evidence.masks, strict=True)]
            partly = sum(c > _PARTLY * area for c, area in zip(changed, areas, strict=True)) >= 2
            scores = [change.score[c].mean() for change, c in zip(evidence.changes, cover, strict=True) if c.any()]
            if partly or (len(scores) >= 2 and np.mean(scores) > _OFF):
                yield k, cover


def _elsewhere(after: SE3, before: SE3, template: Template, size: float) -> bool:
    """Whether two poses of a template differ by more than poses are known."""
    middle = jnp.asarray(middle_of(np.asarray(template.splats.means)), jnp.float32)
    turn = float(rotation_angle((before.inverse() @ after).quat))
    shift = np.linalg.norm(np.asarray(after.apply(middle[None]) - before.apply(middle[None])))
    return bool(turn > _TURNED or shift > _SHIFTED * size)
