"""Do two aligned point sets show one surface? Chamfer distances, both ways and trimmed."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ltgs_jax.geometry import SE3

_BLOCK = 256


class Overlap(eqx.Module):
    """How well two surfaces agree where they overlap.

    `src_to_dst`, `dst_to_src` trimmed mean distances, `distance` the larger, all relative to the object's size;
    `src_covered`, `dst_covered` shares of points with a partner within τ_overlap of the size; `accepted` whether
    `distance` ≤ τ_overlap.
    """

    src_to_dst: Float[Array, ""]
    dst_to_src: Float[Array, ""]
    distance: Float[Array, ""]
    src_covered: Float[Array, ""]
    dst_covered: Float[Array, ""]
    accepted: Bool[Array, ""]


def chamfer(a: Float[Array, "n 3"], b: Float[Array, "m 3"]) -> Float[Array, " n"]:
    """Distance of each point of `a` to its nearest point of `b`, in blocks of bounded memory.

    Raises ValueError when either set is empty. Not differentiable where the nearest point changes or the distance
    is 0 (its gradient there is 0).
    """
    a, b = jnp.asarray(a), jnp.asarray(b)
    if a.shape[0] == 0 or b.shape[0] == 0:
        raise ValueError(f"chamfer: expected points on both sides, got {a.shape[0]} and {b.shape[0]}")

    def nearest(point):
        return jnp.min(jnp.sum((point - b) ** 2, axis=-1))

    squared = jax.lax.map(nearest, a, batch_size=min(_BLOCK, a.shape[0]))
    positive = squared > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, squared, 1)), 0)


def _trimmed_mean(distances: Float[Array, " n"], keep: float) -> Float[Array, ""]:
    count = max(1, round(keep * distances.shape[0]))
    return jnp.mean(jnp.sort(distances)[:count])


def verify_overlap(
    dst_from_src: SE3,
    src: Float[Array, "n 3"],
    dst: Float[Array, "m 3"],
    *,
    tau_overlap: float = 0.15,
    keep: float = 0.5,
    size: float | Float[Array, ""] | None = None,
) -> Overlap:
    """Geometric verification of a registration (the paper's τ_overlap), symmetric and aware of partial overlap.

    `keep` is the share of best distances that enter the mean of each direction, since two visits see different sides;
    `size` the diameter of the object in the unit of the points, by default the diagonal of the smaller bounding box;
    `tau_overlap` relative to `size`.
    """
    src, dst = jnp.asarray(src), jnp.asarray(dst)
    moved = dst_from_src.apply(src)
    forward, backward = chamfer(moved, dst), chamfer(dst, moved)
    if size is None:
        diagonals = [jnp.linalg.norm(jnp.max(x, axis=0) - jnp.min(x, axis=0)) for x in (src, dst)]
        size = jnp.minimum(*diagonals)
    size = jnp.maximum(jnp.asarray(size, src.dtype), jnp.finfo(src.dtype).tiny)
    src_to_dst, dst_to_src = (_trimmed_mean(d, keep) / size for d in (forward, backward))
    distance = jnp.maximum(src_to_dst, dst_to_src)
    return Overlap(
        src_to_dst=src_to_dst,
        dst_to_src=dst_to_src,
        distance=distance,
        src_covered=jnp.mean(forward <= tau_overlap * size),
        dst_covered=jnp.mean(backward <= tau_overlap * size),
        accepted=distance <= tau_overlap,
    )
