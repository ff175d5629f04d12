"""Splats to image: means, conics in LDL form, extents, colours."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, UInt32

from ltgs_jax.geometry import Camera, eval_sh, rotmat_entries
from ltgs_jax.scene import Splats

from .config import ALPHA_MIN, EPS2D

# Larger inputs are culled: their squares would leave float32's range. Far beyond any scene in any unit.
_LARGEST = 1e15


class Projected(eqx.Module):
    """n splats as one camera sees them.

    `means2d` pixels; the exponent at offset (dx, dy) is ½[(dx·inverse_a)² + ((dy − slope·dx)·inverse_b)²], the LDL form
    of fact 1 in the conventions; `extents` half sizes in pixels of the box outside of which α < 1/255; `reach` the
    exponent at which α = 1/255; `visible` false for culled splats, whose other fields are finite and meaningless.
    `remainders` is what float32 `means2d` lack of their value in float64, and `depth_words` are the high and low bits
    of float64 depths, whose order is theirs: rounding of either in float32 would show in the image.
    """

    means2d: Float[Array, "n 2"]
    remainders: Float[Array, "n 2"]
    inverse_a: Float[Array, " n"]
    slope: Float[Array, " n"]
    inverse_b: Float[Array, " n"]
    opacities: Float[Array, " n"]
    depths: Float[Array, " n"]
    depth_words: UInt32[Array, "n 2"]
    colors: Float[Array, "n ch"]
    extents: Float[Array, "n 2"]
    reach: Float[Array, " n"]
    visible: Bool[Array, " n"]


def _bounded(x: Float[Array, "n ..."], largest: float = _LARGEST) -> Bool[Array, " n"]:
    """Whether all entries of each row are numbers of usable size (false for NaN)."""
    return jnp.all(jnp.abs(x) <= largest, axis=tuple(range(1, x.ndim)))


def _all_bounded(columns: list[Float[Array, " n"]]) -> Bool[Array, " n"]:
    """`_bounded` of the rows that columns make."""
    return functools.reduce(jnp.logical_and, [jnp.abs(x) <= _LARGEST for x in columns])


def _choose(mask: Bool[Array, " n"], x: Float[Array, "n ..."], other: float) -> Float[Array, "n ..."]:
    """Rows of `x` where the mask holds, a constant elsewhere: the inner half of a double where."""
    return jnp.where(mask.reshape(mask.shape + (1,) * (x.ndim - 1)), x, jnp.asarray(other, x.dtype))


def _columns(x: Float[Array, "n d"]) -> tuple[Float[Array, " n"], ...]:
    """Columns by splitting: the transpose of a split is one concatenation, of an index a padded array per column."""
    return tuple(column[:, 0] for column in jnp.split(x, x.shape[1], axis=1))


class _Prepared(eqx.Module):
    """What of n splats does not depend on the camera: which are usable, and of these the parameters, by columns.

    `values` are colours, or coefficients of spherical harmonics; unusable splats hold harmless numbers.
    """

    usable: Bool[Array, " n"]
    means: tuple[Float[Array, " n"], ...]
    quats: tuple[Float[Array, " n"], ...]
    scales: tuple[Float[Array, " n"], ...]
    opacities: Float[Array, " n"]
    values: Float[Array, "n ..."]


def _prepare(splats: Splats, colors: Float[Array, "n ch"] | None) -> _Prepared:
    """Splats by columns, those with entries that are NaN, infinite or beyond 1e15 put aside."""
    values = splats.sh if colors is None else colors
    usable = _bounded(splats.means) & _bounded(splats.quats, float(jnp.finfo(splats.means.dtype).max))
    # A logarithm of −∞ is a scale of 0, a logit of ±∞ an opacity of 0 or 1: all three are meant so.
    usable &= jnp.all(splats.log_scales <= 34, axis=-1) & (splats.logit_opacities >= -jnp.inf) & _bounded(values)
    quats = _choose(usable, splats.quats, 1)
    # The reciprocal of a quaternion near float32's largest number would be flushed to 0.
    huge = jnp.max(jnp.abs(quats), axis=-1, keepdims=True) > _LARGEST
    quats = quats * jnp.where(huge, 1 / _LARGEST, 1).astype(quats.dtype)
    log_scales = _choose(usable, splats.log_scales, 0)
    columns = [_columns(x) for x in (_choose(usable, splats.means, 0), quats, log_scales)]
    # A branch, because XLA fuses nothing across it: else the gradient's arithmetic ends up inside of the concatenation
    # of its columns, where it does not vectorise and takes twice the time (an optimization_barrier is gone by then).
    # Without a usable splat the numbers do not matter.
    means, quats, log_scales = jax.lax.cond(
        jnp.any(usable), lambda x: x, lambda x: jax.tree.map(jnp.zeros_like, x), columns
    )
    return _Prepared(
        usable=usable,
        means=means,
        quats=quats,
        scales=tuple(jnp.exp(x) for x in log_scales),
        opacities=jax.nn.sigmoid(_choose(usable, splats.logit_opacities, 0)),
        values=_choose(usable, values, 0),
    )


def _times(matrix, vectors: list) -> list:
    """Elementwise 3×3 by list of three arrays: exact products on every device, and no tiny batched matmul."""
    return [matrix[i][0] * vectors[0] + matrix[i][1] * vectors[1] + matrix[i][2] * vectors[2] for i in range(3)]


def _refine(means, camera: Camera, means2d) -> tuple[Float[Array, "n 2"], UInt32[Array, "n 2"]]:
    """`remainders` and `depth_words` of `Projected`, with the projection of the means repeated in float64."""
    means, camera, means2d = jax.lax.stop_gradient((means, camera, means2d))
    with jax.enable_x64(True):
        exact = jax.tree.map(lambda x: x.astype(jnp.float64), camera)
        pose, K = exact.cam_from_world, exact.K
        local = _times(pose.rotmat(), [x.astype(jnp.float64) for x in means])
        x, y, z = (v + pose.xyz[i] for i, v in enumerate(local))
        z = jnp.where(z > 0, z, 1)
        pixels = jnp.stack([K[0, 0] * (x / z) + K[0, 2], K[1, 1] * (y / z) + K[1, 2]], axis=-1)
        remainders = (pixels - means2d.astype(jnp.float64)).astype(means2d.dtype)
        # Positive floats order as their bits do.
        bits = jax.lax.bitcast_convert_type(z, jnp.uint64)
        words = [(bits >> jnp.uint64(32)).astype(jnp.uint32), (bits & jnp.uint64(0xFFFFFFFF)).astype(jnp.uint32)]
    return remainders, jnp.stack(words, axis=-1)


def project_splats(
    splats: Splats, cameras: Camera, *, near: float, colors: Float[Array, "n ch"] | None = None
) -> Projected:
    """Project splats into every camera of a batch (EWA splatting with the affine approximation of Zwicker et al. 2001,
    as 3DGS); the fields of camera i are rows i·n … (i+1)·n.

    Culled, with zero gradients: splats nearer than `near`, below 1/255 opacity, or with an entry that is NaN, infinite
    or beyond 1e15. Not differentiable where the direction to a mean leaves 1.3 times the field of view, since the
    Jacobian is frozen there as in 3DGS.
    """
    prepared = _prepare(splats, colors)
    projected = jax.vmap(lambda camera: _project(prepared, camera, near, colors is None))(cameras)
    return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), projected)


def _project(prepared: _Prepared, camera: Camera, near: float, harmonics: bool) -> Projected:
    """One camera of `project_splats`; `harmonics` when the values are coefficients."""
    means, opacities, values = prepared.means, prepared.opacities, prepared.values
    dtype = opacities.dtype
    camera_usable = _bounded(jnp.concatenate([x.ravel() for x in jax.tree.leaves(camera)])[None])[0]
    camera = jax.tree.map(lambda x: jnp.where(camera_usable, x, jnp.ones_like(x)).astype(dtype), camera)
    usable = prepared.usable & camera_usable

    rotmat = camera.cam_from_world.rotmat()
    local = [x + camera.cam_from_world.xyz[i] for i, x in enumerate(_times(rotmat, means))]
    in_front = usable & (local[2] >= near) & _all_bounded(local)
    x, y, z = (jnp.where(in_front, v, fill) for v, fill in zip(local, (0, 0, 1), strict=True))

    fx, fy, cx, cy = camera.K[0, 0], camera.K[1, 1], camera.K[0, 2], camera.K[1, 2]
    means2d = jnp.stack([fx * (x / z) + cx, fy * (y / z) + cy], axis=-1)

    remainders, depth_words = _refine(means, camera, means2d)
    remainders = jnp.where(in_front[:, None] & (jnp.abs(remainders) < 1), remainders, 0)

    # 3DGS freezes the affine approximation outside of 1.3 times the field of view.
    margin_x, margin_y = 0.15 * camera.width / fx, 0.15 * camera.height / fy
    tan_x = jnp.clip(x / z, -cx / fx - margin_x, (camera.width - cx) / fx + margin_x)
    tan_y = jnp.clip(y / z, -cy / fy - margin_y, (camera.height - cy) / fy + margin_y)
    axes, sizes = rotmat_entries(*prepared.quats), prepared.scales
    # M = J·W·R·S, row by row (2×3); its minors give the determinant without cancellation.
    turned = [_times(rotmat, [axes[i][j] * sizes[j] for i in range(3)]) for j in range(3)]
    row_x = [fx / z * (turned[j][0] - tan_x * turned[j][2]) for j in range(3)]
    row_y = [fy / z * (turned[j][1] - tan_y * turned[j][2]) for j in range(3)]
    visible = in_front & _all_bounded(row_x + row_y)
    row_x, row_y = ([jnp.where(visible, v, 0) for v in row] for row in (row_x, row_y))
    xx, yy = sum(v * v for v in row_x), sum(v * v for v in row_y)
    a, c = xx + EPS2D, yy + EPS2D
    slope = sum(u * v for u, v in zip(row_x, row_y, strict=True)) / a
    inverse_a = jax.lax.rsqrt(a)
    unit = [v * inverse_a for v in row_x]
    minors = [
        unit[1] * row_y[2] - unit[2] * row_y[1],
        unit[2] * row_y[0] - unit[0] * row_y[2],
        unit[0] * row_y[1] - unit[1] * row_y[0],
    ]
    det_over_a = sum(v * v for v in minors) + EPS2D * (1 + yy / a)
    inverse_b = jax.lax.rsqrt(det_over_a)

    if harmonics:
        direction = jnp.stack(means, axis=-1) - camera.center()
        squared = jnp.sum(direction * direction, axis=-1, keepdims=True)
        safe = in_front[:, None] & (squared > 0)
        direction = jnp.where(safe, direction, 1) * jax.lax.rsqrt(jnp.where(safe, squared, 3))
        values = eval_sh(values, direction)

    reach = jnp.log(jnp.maximum(opacities, ALPHA_MIN) / ALPHA_MIN)
    visible &= opacities >= ALPHA_MIN
    extents = jnp.sqrt(2 * reach)[:, None] * jnp.sqrt(jnp.stack([a, c], axis=-1))
    return Projected(
        means2d=means2d,
        remainders=remainders,
        inverse_a=inverse_a,
        slope=slope,
        inverse_b=inverse_b,
        opacities=opacities,
        depths=z,
        depth_words=depth_words,
        colors=values,
        extents=jax.lax.stop_gradient(extents),
        reach=jax.lax.stop_gradient(reach),
        visible=visible,
    )
