"""The scene over all visits: background, templates, where each was and whether it was there."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ltgs_jax.geometry import SE3

from .shadows import Shadows, ground_gain
from .splats import Splats, concatenate_splats, shade_splats, transform_splats


class Template(eqx.Module):
    """The splats of one object in one state, in the template's own frame.

    `identity` is the object (two states of one object share it), `source_visit` the visit it was first seen at. A
    template cut from the first visit has the world's frame.
    """

    splats: Splats
    identity: int = eqx.field(static=True)
    source_visit: int = eqx.field(static=True)


class Chronology(eqx.Module):
    """Background and k templates over t visits.

    `world_from_template[t, k]` is the paper's P₀→ₜ, `visible[t, k]` its temporal opacity filter M_{t,o}; `exposure`
    [p 3 2] is gain and offset per channel of each of the p photographs in `photographs` that has its own (none when
    the light did not change); `since` [n] the visit from which on each of the background's splats shows, ground that a
    later visit brought to light (None: all from the first); `shade` [t k 4] how each template is lit where it stands,
    beside where it was first seen: log of the gain on its colours, a constant and a slope per scene unit along the
    axes of its frame (None: as it was first seen, everywhere); `shadows` what objects do to the colours of the
    ground around where they stand (None: nothing).
    """

    background: Splats
    templates: tuple[Template, ...]
    world_from_template: SE3
    visible: Bool[Array, "t k"]
    exposure: Float[Array, "p 3 2"]
    visits: tuple[str, ...] = eqx.field(static=True)
    photographs: tuple[str, ...] = eqx.field(static=True, default=())
    since: Int[Array, " n"] | None = None
    shade: Float[Array, "t k 4"] | None = None
    shadows: Shadows | None = None

    @staticmethod
    def of_initial(background: Splats, visits: tuple[str, ...]) -> "Chronology":
        """A chronology in which nothing has happened yet."""
        dtype = background.means.dtype
        return Chronology(
            background=background,
            templates=(),
            world_from_template=SE3.identity((len(visits), 0), dtype),
            visible=jnp.zeros((len(visits), 0), bool),
            exposure=jnp.zeros((0, 3, 2), dtype),
            visits=visits,
        )


def ground_layers(chronology: Chronology) -> dict[int, Splats]:
    """The background's splats by the visit from which on they show, the first visit's included; outside jit only."""
    if chronology.since is None:
        return {0: chronology.background}
    since = np.asarray(chronology.since)
    return {int(t): chronology.background[since == t] for t in np.unique(np.append(since, 0))}


def light(chronology: Chronology, t: int | Int[Array, ""]) -> tuple[Splats, Splats | None]:
    """The background, and all templates one after the other in their own frames (None without any), with their colours
    as they are lit at visit `t`."""
    background = chronology.background
    if chronology.shadows is not None:
        since = jnp.zeros(background.count, jnp.int32) if chronology.since is None else jnp.asarray(chronology.since)
        background = shade_splats(background, ground_gain(chronology.shadows, background.means, since, t))
    if not chronology.templates:
        return background, None
    # All templates at once: what there is to compile does not grow with their number.
    splats = concatenate_splats([template.splats for template in chronology.templates])
    if chronology.shade is not None:
        shade = chronology.shade[t][owner_of(chronology)]
        splats = shade_splats(splats, shade[:, 0] + jnp.sum(shade[:, 1:] * splats.means, axis=-1))
    return background, splats


def owner_of(chronology: Chronology) -> Int[np.ndarray, " n"]:
    """The template of each splat, all templates' one after the other."""
    return np.repeat(np.arange(len(chronology.templates)), [m.splats.count for m in chronology.templates])


def compose(chronology: Chronology, t: int | Int[Array, ""]) -> Splats:
    """The scene at visit `t`: background, then every template moved to its pose, hidden where it is not visible.

    Equation 1 of the LTGS paper and its opacity filter, and the shade of each object and of the ground. What is hidden
    keeps its place in the arrays with opacity 0, so that the shapes do not depend on `t`, which may be traced;
    `drop_hidden` leaves it out.

    Raises ValueError when `t` is not a visit.
    """
    visits = chronology.visible.shape[0]
    if isinstance(t, int) and not 0 <= t < visits:
        raise ValueError(f"t: expected a visit from 0 to {visits - 1}, got {t}")
    background, templates = light(chronology, t)
    if chronology.since is not None:
        logits = jnp.where(chronology.since <= t, background.logit_opacities, -jnp.inf)
        background = eqx.tree_at(lambda s: s.logit_opacities, background, logits)
    if templates is None:
        return background
    owner = owner_of(chronology)
    moved = transform_splats(chronology.world_from_template[t], templates, owner)
    logits = jnp.where(chronology.visible[t][owner], moved.logit_opacities, -jnp.inf)
    return concatenate_splats([background, eqx.tree_at(lambda s: s.logit_opacities, moved, logits)])


def drop_hidden(splats: Splats) -> Splats:
    """Leave out the splats that `compose` hid; outside jit only, since the count changes."""
    return splats[splats.logit_opacities > -jnp.inf]
