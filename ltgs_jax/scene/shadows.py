"""How objects shade the ground around the places where they stand."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

_REACH = 3.0  # radii, beyond which a blob ends


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

    def add(total, blob):
        center, radius, log_gain, cast = blob
        distance = jnp.sum(((means - center) / radius) ** 2, axis=-1)
        weight = jnp.where(distance < _REACH**2, jnp.exp(-0.5 * distance), 0)
        there, then = cast[t].astype(means.dtype), cast[since].astype(means.dtype)
        return total + (there - then) * log_gain * weight, None

    blobs = shadows.centers, shadows.radii, shadows.log_gain, shadows.cast.T
    return jax.lax.scan(add, jnp.zeros_like(means[:, 0]), blobs)[0]
