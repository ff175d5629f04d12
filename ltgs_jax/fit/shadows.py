"""Where the long fit lays the blobs of shadows."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from ltgs_jax.scene import Shadows, Splats

_BLOBS = 16  # around each place
_AROUND = 0.9  # of an object's diameter: how far from its middle
_RADIUS = 0.25  # of an object's diameter


def lay_blobs(
    ground: Splats,
    middles: Float[np.ndarray, "p 3"],
    diameters: Float[np.ndarray, " p"],
    occupied: Bool[np.ndarray, "t p"],
) -> Shadows:
    """Blobs without effect on the ground around each place [p] that is not `occupied` at all visits alike, spread
    evenly by farthest points."""
    means = np.asarray(ground.means)[np.asarray(ground.opacities) > 0.1]
    centers, radii, cast = [np.zeros((0, 3))], [], [np.zeros((0, len(occupied)), bool)]
    for middle, diameter, there in zip(middles, diameters, occupied.T, strict=True):
        if there.all() or not there.any():
            continue
        spread = _spread(means, middle, _AROUND * diameter)
        centers.append(spread)
        radii += [_RADIUS * diameter] * len(spread)
        cast.append(np.tile(there, (len(spread), 1)))
    return Shadows(
        jnp.asarray(np.concatenate(centers), jnp.float32),
        jnp.asarray(radii, jnp.float32),
        jnp.zeros(len(radii), jnp.float32),
        jnp.asarray(np.concatenate(cast).T),
    )


def _spread(points: Float[np.ndarray, "n 3"], middle: Float[np.ndarray, "3"], reach: float) -> Float[np.ndarray, "m 3"]:
    """At most `_BLOBS` of the points within reach: the nearest, then always the one farthest from those before."""
    away = np.linalg.norm(points - middle, axis=1)
    near = points[away < reach]
    if len(near) == 0:
        return near
    chosen = [int(np.argmin(away[away < reach]))]
    distance = np.linalg.norm(near - near[chosen[0]], axis=1)
    while len(chosen) < min(_BLOBS, len(near)):
        chosen.append(int(np.argmax(distance)))
        distance = np.minimum(distance, np.linalg.norm(near - near[chosen[-1]], axis=1))
    return near[chosen]
