"""How objects shade the ground around the places where they stand."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

_REACH = 3.0  # radii, beyond which a blob ends
_AT_ONCE = 8192  # splats whose distances to all blobs are in memory


class Shadows(eqx.Module):
    """m Gaussian blobs in world coordinates, each part of the shadow of one object at one place.

    `centers` and standard deviations `radii` in scene units; `log_gain` is what each puts on the ground's colours in
    its middle; `cast[t]` says which there are at visit t.
    """

    centers: Float[Array, "m 3"]
    radii: Float[Array, " m"]
    log_gain: Float[Array, " m"]
    cast: Bool[Array, "t m"]


def ground_gain(
    shadows: Shadows, means: Float[Array, "n 3"], since: Int[Array, " n"], t: int | Int[Array, ""]
) -> Float[Array, " n"]:
    """Log of the gain on the colours of the ground's splats at visit t, beside visit `since`, whose shadows are in the
    colours already; exactly 0 where nothing came or left."""

    effects = (shadows.cast[t].astype(means.dtype) - shadows.cast.astype(means.dtype)) * shadows.log_gain

    def effect(row):
        mean, since = row
        distance = sum(((mean[i] - shadows.centers[:, i]) / shadows.radii) ** 2 for i in range(3))
        weights = jnp.where(distance < _REACH**2, jnp.exp(-0.5 * distance), 0)
        return jnp.matmul(effects, weights, precision="highest")[since]

    return jax.lax.map(effect, (means, since), batch_size=_AT_ONCE)
