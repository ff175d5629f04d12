"""Where splats are added at fixed capacity: faint ones are recycled as halves of those that carry most error."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ltgs_jax.geometry import rotmat_from_quat
from ltgs_jax.scene import Splats

FAINT = 0.005  # opacity under which a splat adds nothing that an 8-bit image shows
# Halves of a split Gaussian: offset and standard deviation along its longest axis that keep the first two moments.
_OFFSET = 0.75
_SHRINK = (1 - _OFFSET**2) ** 0.5


def faint(splats: Splats) -> Bool[Array, " n"]:
    """Splats whose slot is free."""
    return splats.opacities < FAINT


@eqx.filter_jit
def recycle(splats: Splats, scores: Float[Array, " n"], most: Array) -> tuple[Splats, Bool[Array, " n"]]:
    """Split the splats of highest score into halves, the second half in the slot of a faint one.

    At most `most` splits. Opacity o of each half is 1 − √(1−o), so that both together absorb as one did. Returns the
    splats and the mask of rows that were replaced. Not differentiable.
    """
    n = splats.count
    free = faint(splats)
    order = jnp.argsort(jnp.where(free | ~jnp.isfinite(scores), -jnp.inf, scores), descending=True)
    slots = jnp.argsort(~free, stable=True)
    rank = jnp.arange(n)
    usable = (rank < most) & (rank < jnp.sum(free)) & (rank < n - jnp.sum(free)) & (scores[order] > 0)
    sources = order
    axis = jnp.argmax(splats.log_scales[sources], axis=-1)
    rotmats = rotmat_from_quat(splats.quats[sources])
    direction = jnp.take_along_axis(rotmats, axis[:, None, None], axis=2)[..., 0]
    length = jnp.take_along_axis(splats.scales[sources], axis[:, None], axis=1)
    shift = _OFFSET * length * direction
    halves = splats[sources]
    log_scales = halves.log_scales.at[jnp.arange(n), axis].add(jnp.log(jnp.asarray(_SHRINK, splats.means.dtype)))
    opacity = 1 - jnp.sqrt(1 - halves.opacities)
    halves = eqx.tree_at(
        lambda s: (s.log_scales, s.logit_opacities), halves, (log_scales, jnp.log(opacity) - jnp.log1p(-opacity))
    )
    first = eqx.tree_at(lambda s: s.means, halves, halves.means + shift)
    second = eqx.tree_at(lambda s: s.means, halves, halves.means - shift)
    into_first = jnp.where(usable, sources, n)
    into_second = jnp.where(usable, slots, n)

    def put(leaf, a, b):
        return leaf.at[into_first].set(a, mode="drop").at[into_second].set(b, mode="drop")

    replaced = jnp.zeros(n, bool).at[into_first].set(True, mode="drop").at[into_second].set(True, mode="drop")
    return jax.tree.map(put, splats, first, second), replaced
