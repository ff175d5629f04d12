"""The scene over all visits: background, templates, where each was and whether it was there."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ltgs_jax.geometry import SE3

from .splats import Splats, concatenate_splats, transform_splats


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
    the light did not change).
    """

    background: Splats
    templates: tuple[Template, ...]
    world_from_template: SE3
    visible: Bool[Array, "t k"]
    exposure: Float[Array, "p 3 2"]
    visits: tuple[str, ...] = eqx.field(static=True)
    photographs: tuple[str, ...] = eqx.field(static=True, default=())

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


def compose(chronology: Chronology, t: int | Int[Array, ""]) -> Splats:
    """The scene at visit `t`: background, then every template moved to its pose, hidden where it is not visible.

    Equation 1 of the LTGS paper and its opacity filter. Hidden templates keep their place in the arrays with opacity 0,
    so that the shapes do not depend on `t`, which may be traced; `drop_hidden` leaves them out.

    Raises ValueError when `t` is not a visit.
    """
    visits = chronology.visible.shape[0]
    if isinstance(t, int) and not 0 <= t < visits:
        raise ValueError(f"t: expected a visit from 0 to {visits - 1}, got {t}")
    if not chronology.templates:
        return chronology.background
    # All templates at once: what there is to compile does not grow with their number.
    splats = concatenate_splats([template.splats for template in chronology.templates])
    owner = np.repeat(np.arange(len(chronology.templates)), [m.splats.count for m in chronology.templates])
    moved = transform_splats(chronology.world_from_template[t], splats, owner)
    logits = jnp.where(chronology.visible[t][owner], moved.logit_opacities, -jnp.inf)
    return concatenate_splats([chronology.background, eqx.tree_at(lambda s: s.logit_opacities, moved, logits)])


def drop_hidden(splats: Splats) -> Splats:
    """Leave out the splats that `compose` hid; outside jit only, since the count changes."""
    return splats[splats.logit_opacities > -jnp.inf]
