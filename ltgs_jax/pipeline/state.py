"""The chronology so far, what the stages know beside it, and how both lie on disk."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from ltgs_jax.geometry import SE3
from ltgs_jax.io import arrays_of, module_of
from ltgs_jax.scene import Chronology, Shadows, Splats, Template, compose, concatenate_splats
from ltgs_jax.template import Placement, Support, middle_of

from .looks import on_host


class State(eqx.Module):
    """The chronology so far, and what the stages know beside it.

    `errors` expected dissimilarity of each background splat, `template_errors` of each template's; `guessed`
    background splats that no photograph has shown; `supports` the surface that each template stood on where its frame
    is.
    """

    chronology: Chronology
    errors: Float[np.ndarray, " n"]
    guessed: Bool[np.ndarray, " n"]
    template_errors: tuple[Float[np.ndarray, " m"], ...]
    supports: tuple[Support | None, ...]

    @classmethod
    def of_initial(cls, splats: Splats, errors: Float[np.ndarray, " n"], visits: tuple[str, ...]) -> "State":
        """The first visit alone."""
        chronology = Chronology.of_initial(splats, visits)
        chronology = eqx.tree_at(lambda c: c.since, chronology, np.zeros(splats.count, np.int32), is_leaf=_is_none)
        return cls(chronology, errors, np.zeros(splats.count, bool), (), ())


class Account(eqx.Module):
    """How one object was explained at one visit: kind, share of the change explained, what is left unlike the
    photographs, over how many photographs, the axis [3] in its template's frame about which its turn is unknown, the
    evidence that proposed its pose, if one was sought, and the identities that the outlines of something new are not
    those of."""

    template: int = eqx.field(static=True)
    kind: str = eqx.field(static=True)
    gain: float = eqx.field(static=True)
    residual: float = eqx.field(static=True)
    views: int = eqx.field(static=True)
    ambiguous_axis: tuple[float, ...] | None = eqx.field(static=True, default=None)
    evidence: str | None = eqx.field(static=True, default=None)
    other_than: tuple[int, ...] = eqx.field(static=True, default=())

    @classmethod
    def of_placed(cls, template: int, kind: str, found: Placement, views: int) -> "Account":
        """Of a template that was found again."""
        axis = None if found.ambiguous_axis is None else tuple(map(float, found.ambiguous_axis))
        return cls(template, kind, found.gain, found.error, views, axis, found.evidence)

    @classmethod
    def from_json(cls, entry: dict) -> "Account":
        """What `to_json` gave."""
        axis, others = entry.get("ambiguous_axis"), tuple(entry.get("other_than", ()))
        return cls(**{**entry, "ambiguous_axis": None if axis is None else tuple(axis), "other_than": others})

    def to_json(self) -> dict:
        """As JSON holds it."""
        return {
            "template": self.template,
            "kind": self.kind,
            "gain": float(self.gain),
            "residual": float(self.residual),
            "views": self.views,
            "ambiguous_axis": self.ambiguous_axis,
            "evidence": self.evidence,
            "other_than": self.other_than,
        }


_compose = eqx.filter_jit(compose)  # eagerly, every template's new shape would compile every operation anew


def composed(chronology: Chronology, t: int) -> Splats:
    """`compose` by one program, on the host."""
    return on_host(_compose(chronology, jnp.asarray(t)))


def scene_at(
    state: State, t: int
) -> tuple[Splats, Float[np.ndarray, " n"], Int[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
    """The scene at visit t with hidden templates left out: splats, expected errors, owner (0 background, 1 + k), and
    whether guessed."""
    splats = composed(state.chronology, t)
    errors = np.concatenate([state.errors, *state.template_errors])
    counts = [state.chronology.background.count, *[m.splats.count for m in state.chronology.templates]]
    owner = np.repeat(np.arange(len(counts)), counts)
    guessed = np.pad(state.guessed, (0, len(owner) - len(state.guessed)))
    keep = np.asarray(splats.logit_opacities) > -np.inf
    return splats[keep], errors[keep], owner[keep], guessed[keep]


def set_from(state: State, t: int, k: int, *, visible: bool, pose: SE3 | None = None, unsure: float = 0.0) -> State:
    """Template k from visit t on: whether it is there, and where."""
    chronology = state.chronology
    flags = np.array(chronology.visible)
    flags[t:, k] = visible
    poses = chronology.world_from_template
    if pose is not None:
        # Sides and edges that the first pose never showed: only a strong difference there is a change.
        state = doubt_template(state, k, np.full(len(state.template_errors[k]), unsure))
        quat, xyz = np.array(poses.quat), np.array(poses.xyz)
        quat[t:, k], xyz[t:, k] = np.asarray(pose.quat), np.asarray(pose.xyz)
        poses = SE3(quat, xyz)
    chronology = eqx.tree_at(lambda c: (c.visible, c.world_from_template), chronology, (flags, poses))
    return eqx.tree_at(lambda s: s.chronology, state, chronology)


def came_to_place(state: State, t: int, k: int) -> int:
    """The visit from which on template k has stood where it stands at visit t; 0 where it always has."""
    moves = state.chronology.world_from_template
    poses = np.concatenate([moves.quat, moves.xyz], axis=-1)[: t + 1, k]
    same = (poses == poses[t]).all(axis=1) & np.asarray(state.chronology.visible)[: t + 1, k]
    return int(np.flatnonzero(~same).max(initial=-1)) + 1


def doubt_template(state: State, k: int, least: Float[np.ndarray, " m"]) -> State:
    """Template k with at least these errors expected of its splats."""
    errors = np.maximum(state.template_errors[k], least).astype(np.float32)
    return eqx.tree_at(lambda s: s.template_errors[k], state, errors)


def next_identity(state: State) -> int:
    """The first that no template has."""
    return 1 + max([m.identity for m in state.chronology.templates], default=0)


def add_template(state: State, template: Template, errors: np.ndarray, support: Support | None, first: int) -> State:
    """A new template, at its own frame's pose, visible from visit `first` on."""
    chronology = state.chronology
    visits = chronology.visible.shape[0]
    identity = SE3.identity((visits, 1), jnp.float32)
    poses = jax.tree.map(lambda a, b: np.concatenate([a, b], axis=1), chronology.world_from_template, identity)
    column = (np.arange(visits) >= first)[:, None]
    template = eqx.tree_at(lambda m: m.splats, template, on_host(template.splats))
    return _with_templates(
        state,
        (*chronology.templates, template),
        poses,
        np.concatenate([chronology.visible, column], axis=1),
        (*state.template_errors, errors),
        (*state.supports, support),
    )


def split_template(state: State, k: int, part: Bool[np.ndarray, " m"], support: Support) -> State:
    """Template k without a part, which becomes one of its own, last, with the same poses and visits so far."""
    chronology = state.chronology
    whole, errors = chronology.templates[k], state.template_errors[k]
    poses = jax.tree.map(
        lambda leaf: np.concatenate([leaf, leaf[:, k : k + 1]], axis=1), chronology.world_from_template
    )
    rest = eqx.tree_at(lambda m: m.splats, whole, whole.splats[~part])
    others = [rest if i == k else m for i, m in enumerate(chronology.templates)]
    return _with_templates(
        state,
        (*others, Template(whole.splats[part], next_identity(state), whole.source_visit)),
        poses,
        np.concatenate([chronology.visible, np.asarray(chronology.visible)[:, k : k + 1]], axis=1),
        (*[errors[~part] if i == k else e for i, e in enumerate(state.template_errors)], errors[part]),
        (*state.supports, support),
    )


def hand_over(state: State, k: int, part: Bool[np.ndarray, " m"], to: int) -> State:
    """A part of template k as more of another, whose frame and poses so far are the same."""
    whole, errors = state.chronology.templates[k].splats, state.template_errors[k]
    return extend_template(cut_template(state, k, part), to, whole[part], errors[part])


def cut_template(state: State, k: int, taken: Bool[np.ndarray, " m"]) -> State:
    """Template k without some of its splats."""
    return eqx.tree_at(
        lambda s: (s.chronology.templates[k].splats, s.template_errors[k]),
        state,
        (state.chronology.templates[k].splats[~taken], state.template_errors[k][~taken]),
    )


def middles_of(state: State, k: int) -> Float[np.ndarray, "t 3"]:
    """Where the middle of template k is at its pose of each visit, in world coordinates."""
    middle = jnp.asarray(middle_of(np.asarray(state.chronology.templates[k].splats.means)), jnp.float32)
    poses = state.chronology.world_from_template[:, k]
    return np.asarray(poses.apply(jnp.broadcast_to(middle, (len(state.chronology.visits), 1, 3))))[:, 0]


def drop_template(state: State, k: int) -> State:
    """The state without template k; those after it move up by one."""
    chronology = state.chronology
    keep = [i for i in range(len(chronology.templates)) if i != k]
    return _with_templates(
        state,
        tuple(chronology.templates[i] for i in keep),
        jax.tree.map(lambda leaf: np.asarray(leaf)[:, keep], chronology.world_from_template),
        np.asarray(chronology.visible)[:, keep],
        tuple(state.template_errors[i] for i in keep),
        tuple(state.supports[i] for i in keep),
    )


def _with_templates(state: State, templates, poses: SE3, visible, errors, supports) -> State:
    old = state.chronology
    chronology = Chronology(
        old.background, templates, poses, visible, old.exposure, old.visits, old.photographs, old.since
    )
    return State(chronology, state.errors, state.guessed, errors, supports)


def extend_template(state: State, k: int, splats: Splats, errors: np.ndarray) -> State:
    """More splats, in its own frame, for a template."""
    joined = concatenate_splats([state.chronology.templates[k].splats, splats])
    return eqx.tree_at(
        lambda s: (s.chronology.templates[k].splats, s.template_errors[k]),
        state,
        (on_host(joined), np.concatenate([state.template_errors[k], errors])),
    )


def extend_background(state: State, splats: Splats, errors: np.ndarray, guessed: np.ndarray, since: int) -> State:
    """More splats behind everything, from a visit on."""
    chronology = state.chronology
    return eqx.tree_at(
        _of_background,
        state,
        (
            on_host(concatenate_splats([chronology.background, splats])),
            np.concatenate([chronology.since, np.full(splats.count, since, np.int32)]),
            np.concatenate([state.errors, errors.astype(state.errors.dtype)]),
            np.concatenate([state.guessed, guessed]),
        ),
    )


def cut_background(state: State, taken: Bool[np.ndarray, " n"]) -> State:
    """The background without some of its splats."""
    return eqx.tree_at(_of_background, state, tuple(leaf[~taken] for leaf in _of_background(state)))


def _of_background(state: State) -> tuple:
    """What has a row for each of the background's splats."""
    return state.chronology.background, state.chronology.since, state.errors, state.guessed


def _is_none(leaf) -> bool:
    return leaf is None


def pack_state(state: State) -> tuple[dict[str, np.ndarray], dict]:
    """A state as arrays by name, and what JSON holds of it."""
    chronology = state.chronology
    arrays = {
        **arrays_of("background", chronology.background),
        "errors": state.errors,
        "guessed": state.guessed,
        "since": np.asarray(state.chronology.since),
        "quat": np.asarray(chronology.world_from_template.quat),
        "xyz": np.asarray(chronology.world_from_template.xyz),
        "visible": np.asarray(chronology.visible),
    }
    if chronology.shade is not None:
        arrays["shade"] = np.asarray(chronology.shade)
    if chronology.shadows is not None:
        arrays |= arrays_of("shadows", chronology.shadows)
    for k, template in enumerate(chronology.templates):
        arrays |= arrays_of(f"template{k}", template.splats)
        arrays[f"template{k}.errors"] = state.template_errors[k]
        support = state.supports[k]
        if support is not None:
            arrays[f"template{k}.support"] = np.asarray([*support.normal, support.offset, support.noise])
    return arrays, {"templates": [[m.identity, m.source_visit] for m in chronology.templates]}


def unpack_state(arrays: dict[str, np.ndarray], notes: dict, visits: tuple[str, ...]) -> State:
    """The state that `pack_state` named, at as many visits as there are now: later ones are like the last it knew."""
    templates, errors, supports = [], [], []
    for k, (identity, source) in enumerate(notes["templates"]):
        templates.append(Template(module_of(Splats, f"template{k}", arrays), identity, source))
        errors.append(arrays[f"template{k}.errors"])
        packed = arrays.get(f"template{k}.support")
        supports.append(None if packed is None else Support(packed[:3], float(packed[3]), float(packed[4])))
    start = State.of_initial(module_of(Splats, "background", arrays), arrays["errors"], visits)
    start = eqx.tree_at(lambda s: (s.guessed, s.chronology.since), start, (arrays["guessed"], arrays["since"]))
    known = np.minimum(np.arange(len(visits)), len(arrays["visible"]) - 1)
    quat, xyz, visible = (jnp.asarray(arrays[name][known]) for name in ("quat", "xyz", "visible"))
    state = _with_templates(start, tuple(templates), SE3(quat, xyz), visible, tuple(errors), tuple(supports))
    shade, shadows = arrays["shade"][known] if "shade" in arrays else None, None
    if "shadows.cast" in arrays:
        shadows = module_of(Shadows, "shadows", {**arrays, "shadows.cast": arrays["shadows.cast"][known]})
    lit = (shade, shadows)
    return eqx.tree_at(lambda s: (s.chronology.shade, s.chronology.shadows), state, lit, is_leaf=_is_none)
