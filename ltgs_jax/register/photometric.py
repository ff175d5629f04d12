"""Pose of one object from the pixels of all its views: Levenberg–Marquardt on the rendered residual."""

import dataclasses
import enum
import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.lax import Precision
from jaxtyping import Array, Bool, Float, Int
from scipy import ndimage

from ltgs_jax.geometry import SE3, Camera
from ltgs_jax.render import RenderConfig, RenderPlan, gather_tiles, plan_render, render, tiles_of_mask
from ltgs_jax.scene import Splats

# Damping, as a share of the diagonal of the normal equations, at the start; what a step that pays, or does not, makes
# of it; and its least.
_DAMPING, _EASIER, _HARDER, _LEAST_DAMPING = 1e-2, 0.25, 6.0, 1e-5
# No step leaves the region in which a linearisation of pixels can mean anything: shares of the size, radians.
_LONGEST, _WIDEST = 0.15, 0.3
# A refined pose must leave less than this share of the robust cost that the views have without the object.
_WORTH = 0.9
# Costs that differ by less are equal, in shares.
_EQUAL = 1e-3
# Room of the plan for poses that move; the next where that was too little.
_SLACKS = (1.5, 3.0, 8.0)
# A splat's pixel counts as the object's where it is this opaque.
_SEEN = 0.01


class PoseResult(enum.IntEnum):
    """Codes of `PoseFit.result`."""

    SUCCESS = 0
    NOT_CONVERGED = 1
    NO_GAIN = 2
    OUT_OF_VIEW = 3
    DIVERGED = 4

    @property
    def reason(self) -> str:
        """The code in words."""
        return {
            PoseResult.SUCCESS: "the pose is where the pixels fit best",
            PoseResult.NOT_CONVERGED: "the pose still moved when the steps ran out",
            PoseResult.NO_GAIN: "the object at this pose explains the pixels hardly better than its absence",
            PoseResult.OUT_OF_VIEW: "no pixel that counts shows the object",
            PoseResult.DIVERGED: "the descent ended at a worse pose than it began; the start is given back",
        }[self]


class PhotometricConfig(eqx.Module):
    """Options of `refine_pose`; all static."""

    coarse_steps: int = eqx.field(static=True, default=4)
    """Steps on residuals averaged over blocks of `coarse` × `coarse` pixels, which widens the basin."""
    coarse: int = eqx.field(static=True, default=4)
    """Side of those blocks in pixels; divides the renderer's tile."""
    steps: int = eqx.field(static=True, default=16)
    """Most steps in all."""
    scale: float = eqx.field(static=True, default=0.15)
    """Colour difference at which the Geman–McClure weight of a pixel has fallen to a quarter."""
    tolerance: float = eqx.field(static=True, default=1e-3)
    """A step shorter than this, in shares of the size and in radians, ends the descent."""
    margin: int = eqx.field(static=True, default=12)
    """Pixels around the outlines at the starting poses whose tiles are worked on."""
    render: RenderConfig = eqx.field(static=True, default=RenderConfig())


class Views(eqx.Module):
    """What v photographs, or windows of them, show where one object stands.

    `camera` batched over v; `target` the photographs in the scene's light; `backdrop` and `depth` the render of
    everything else (depth in scene units, 0 = nothing there); `valid` the pixels that count.
    """

    camera: Camera
    target: Float[Array, "v h w 3"]
    backdrop: Float[Array, "v h w 3"]
    depth: Float[Array, "v h w"]
    valid: Bool[Array, "v h w"]


class PoseFit(eqx.Module):
    """Refined poses, one per start.

    `poses` world_from_template; `cost` the robust cost per pixel and channel that counts, `start_cost` the same before,
    `empty_cost` without the object; `covariance` of the tangent (v, ω) at the template's middle, from the residuals'
    own size; `steps` how many were tried; `result` codes of `PoseResult`.
    """

    poses: SE3
    cost: Float[Array, " m"]
    start_cost: Float[Array, " m"]
    empty_cost: Float[Array, ""]
    covariance: Float[Array, "m 6 6"]
    steps: Int[Array, " m"]
    result: Int[Array, " m"]


class _Patches(eqx.Module):
    """The views' arrays on the object's tiles alone."""

    camera: Camera
    tiles: Int[Array, "v t"]
    target: Float[Array, "v t s s 3"]
    backdrop: Float[Array, "v t s s 3"]
    depth: Float[Array, "v t s s"]
    valid: Bool[Array, "v t s s"]


class _Point(eqx.Module):
    """A pose with its cost and its normal equations; `covered` sums the object's alpha over what counts."""

    pose: SE3
    cost: Float[Array, " m"]
    normal: Float[Array, "m 6 6"]
    slope: Float[Array, "m 6"]
    covered: Float[Array, " m"]


class _State(eqx.Module):
    """The best point so far, and the pose that is tried next."""

    step: Int[Array, ""]
    best: _Point
    trial: SE3
    damping: Float[Array, " m"]
    done: Bool[Array, " m"]
    tried: Int[Array, " m"]
    start_cost: Float[Array, " m"]
    overflow: Int[Array, ""]


def cameras_at(cameras: Camera, world_from_template: SE3) -> Camera:
    """Cameras that see a template, left in its own frame, as `cameras` [v] see it at poses [m]: batched [m·v]."""
    each = jax.vmap(lambda pose: cameras.cam_from_world @ pose)(world_from_template)
    flat = jax.tree.map(lambda leaf: leaf.reshape(-1, leaf.shape[-1]), each)
    return Camera(flat, jnp.tile(cameras.K, (world_from_template.xyz.shape[0], 1, 1)), cameras.width, cameras.height)


def _choose_tiles(template: Splats, poses: SE3, views: Views, config: PhotometricConfig) -> Int[Array, "v t"]:
    """Tiles of each view that the object reaches at any start, with a margin; −1 pads."""
    alpha = render(template, cameras_at(views.camera, poses), config=config.render).alpha
    seen = (np.asarray(alpha).reshape(-1, *views.depth.shape) > _SEEN).any(0)
    width = 2 * config.margin + 1
    near = ndimage.maximum_filter(seen, (1, width, width)) & np.asarray(views.valid)
    lists = [np.asarray(tiles_of_mask(mask, config=config.render)) for mask in near]
    longest = max(map(len, lists))
    return jnp.asarray(np.stack([np.pad(tiles, (0, longest - len(tiles)), constant_values=-1) for tiles in lists]))


def _cut(views: Views, tiles: Int[Array, "v t"], config: RenderConfig) -> _Patches:
    """The patches of the views on their tiles; padding and pixels beyond the border do not count."""
    cut = jax.vmap(functools.partial(gather_tiles, config=config))
    valid = cut(views.valid.astype(views.depth.dtype), tiles) > 0.5
    images = (cut(image, tiles) for image in (views.target, views.backdrop, views.depth))
    return _Patches(views.camera, tiles, *images, valid)


def pixel_residuals(
    template: Splats, poses: SE3, patches: _Patches, reach: Float[Array, ""], plan: RenderPlan, config: RenderConfig
) -> tuple[Float[Array, "m v t s s 3"], Float[Array, "m v t s s"], Int[Array, ""]]:
    """Colour differences of the composite from the photographs, the object's visible alpha, and the overflow.

    The object shows where it is nearer than what is known there plus `reach`.
    """
    count = poses.xyz.shape[0]
    cameras = cameras_at(patches.camera, poses)
    out = render(template, cameras, plan=plan, tiles=jnp.tile(patches.tiles, (count, 1)), config=config)
    shape = (count, *patches.depth.shape)
    depth = out.depth.reshape(shape)
    front = ((depth < patches.depth + reach) | (patches.depth <= 0)) & patches.valid
    cover = jnp.where(front, out.alpha.reshape(shape), 0)
    image = jnp.where(front[..., None], out.image.reshape(*shape, 3), 0)
    shown = image + (1 - cover)[..., None] * patches.backdrop
    return jnp.where(patches.valid[..., None], shown - patches.target, 0), cover, out.overflow


def _block_means(coarse: Bool[Array, ""], size: int, block: int, dtype) -> Float[Array, "s s"]:
    """Matrix that replaces the pixels of a row by the mean of their block, or the identity."""
    member = np.arange(size) // block
    means = (member[:, None] == member[None, :]) / block
    return jnp.where(coarse, means, np.eye(size)).astype(dtype)


def _robust(residuals: Float[Array, "m p"], scale: float) -> tuple[Float[Array, " m"], Float[Array, "m p"]]:
    """Geman–McClure cost and weights."""
    relative = (residuals / scale) ** 2
    return 0.5 * jnp.sum(scale**2 * relative / (1 + relative), axis=1), 1 / (1 + relative) ** 2


def _pick(choice: Bool[Array, " m"], new, old):
    """Leaf by leaf, rows of one or the other."""
    return jax.tree.map(lambda a, b: jnp.where(choice.reshape(-1, *(1,) * (a.ndim - 1)), a, b), new, old)


def _damped_step(point: _Point, damping: Float[Array, " m"], size: Float[Array, ""]) -> Float[Array, "m 6"]:
    """The Levenberg–Marquardt step, damped relative to the diagonal, shortened as a whole where it is too long."""
    diagonal = jnp.einsum("mii->mi", point.normal)
    least = jnp.finfo(diagonal.dtype).eps * jnp.max(diagonal, axis=1, keepdims=True) + jnp.finfo(diagonal.dtype).tiny
    ridge = (damping[:, None] * diagonal + least)[:, :, None] * jnp.eye(6, dtype=diagonal.dtype)
    step = -jnp.linalg.solve(point.normal + ridge, point.slope[..., None])[..., 0]
    limit = jnp.concatenate([jnp.full(3, _LONGEST, step.dtype) * size, jnp.full(3, _WIDEST, step.dtype)])
    excess = jnp.max(jnp.abs(step) / limit, axis=1, keepdims=True)
    return jnp.where(jnp.isfinite(step).all(1, keepdims=True), step / jnp.maximum(excess, 1), 0)


@functools.partial(jax.jit, static_argnames=("plan", "config"))
def _descend(template, poses, patches: _Patches, size, reach, steps, *, plan: RenderPlan, config: PhotometricConfig):
    """All starts at once, at most `steps`; a step that does not pay is taken back and damped more.

    Step 0 measures the start, the next `coarse_steps` see block means, the rest the pixels.
    """
    count, dtype = poses.xyz.shape[0], poses.xyz.dtype
    fine_from = 1 + config.coarse_steps
    units = jnp.concatenate([jnp.full(3, 1, dtype) / size, jnp.ones(3, dtype)])

    def linearised(pose: SE3, coarse: Bool[Array, ""]) -> tuple[_Point, Int[Array, ""]]:
        average = _block_means(coarse, config.render.tile_size, config.coarse, dtype)

        def seen(tangent):
            moved = pose @ SE3.exp(tangent)
            residuals, cover, overflow = pixel_residuals(template, moved, patches, reach, plan, config.render)
            rows = jnp.einsum("ij,...jkc->...ikc", average, residuals, precision=Precision.HIGHEST)
            blocks = jnp.einsum("kl,...ilc->...ikc", average, rows, precision=Precision.HIGHEST)
            return blocks.reshape(count, -1), (jnp.sum(cover, axis=(1, 2, 3, 4)), overflow)

        residuals, push, (covered, overflow) = jax.linearize(seen, jnp.zeros((count, 6), dtype), has_aux=True)
        jacobian = jax.vmap(push)(jnp.broadcast_to(jnp.eye(6, dtype=dtype)[:, None], (6, count, 6)))
        cost, weights = _robust(residuals, config.scale)
        normal = jnp.einsum("amp,bmp,mp->mab", jacobian, jacobian, weights, precision=Precision.HIGHEST)
        slope = jnp.einsum("amp,mp,mp->ma", jacobian, weights, residuals, precision=Precision.HIGHEST)
        return _Point(pose, cost, normal, slope, covered), overflow

    def advance(state: _State) -> _State:
        coarse = (state.step > 0) & (state.step < fine_from)
        point, overflow = linearised(state.trial, coarse)
        # Where the cost becomes another one, what came before does not compare.
        fresh = (state.step <= 1) | (state.step == fine_from)
        better = fresh | ((point.cost < state.best.cost) & ~state.done)
        best = _pick(better, point, state.best)
        damping = jnp.where(better, jnp.maximum(state.damping * _EASIER, _LEAST_DAMPING), state.damping * _HARDER)
        step = _damped_step(best, damping, size)
        short = jnp.max(jnp.abs(step * units), axis=1) < config.tolerance
        done = (state.done | short) & (state.step >= fine_from)
        restart = (state.step == 0) | (state.step == config.coarse_steps)
        return _State(
            step=state.step + 1,
            best=best,
            trial=_pick(done | restart, best.pose, best.pose @ SE3.exp(step)),
            damping=jnp.where(restart, _DAMPING, damping),
            done=done,
            tried=state.tried + (~state.done).astype(jnp.int32),
            start_cost=jnp.where(state.step == 0, point.cost, state.start_cost),
            overflow=state.overflow + overflow,
        )

    zero = jnp.zeros(count, dtype)
    start = _State(
        step=jnp.asarray(0),
        best=_Point(poses, zero, jnp.zeros((count, 6, 6), dtype), jnp.zeros((count, 6), dtype), zero),
        trial=poses,
        damping=jnp.full(count, _DAMPING, dtype),
        done=jnp.zeros(count, bool),
        tried=jnp.zeros(count, jnp.int32),
        start_cost=zero,
        overflow=jnp.asarray(0),
    )
    end = jax.lax.while_loop(lambda s: (s.step <= steps) & ~jnp.all(s.done), advance, start)
    empty, _ = _robust(
        jnp.where(patches.valid[..., None], patches.backdrop - patches.target, 0).reshape(1, -1), config.scale
    )
    return end, empty[0]


def _verdict(end: _State, poses: SE3, empty: Float[Array, ""], pixels: Float[Array, ""]) -> PoseFit:
    """What a descent from `poses` is worth; costs per channel of a pixel that counts."""
    best = end.best
    # A plan that never had room means a pose that ran into a camera.
    worse = ~(best.cost <= end.start_cost * (1 + _EQUAL)) | (end.overflow > 0)
    result = jnp.where(end.done, int(PoseResult.SUCCESS), int(PoseResult.NOT_CONVERGED))
    result = jnp.where(worse, int(PoseResult.DIVERGED), result)
    cost = jnp.where(worse, end.start_cost, best.cost)
    result = jnp.where(cost < _WORTH * empty, result, int(PoseResult.NO_GAIN))
    result = jnp.where(best.covered >= 1, result, int(PoseResult.OUT_OF_VIEW))
    per_channel = jnp.maximum(3 * pixels, 1)
    # Gauss–Newton: the residuals' mean square times the inverse of the normal equations.
    spread = (2 * best.cost / per_channel)[:, None, None]
    return PoseFit(
        poses=_pick(worse, poses, best.pose),
        cost=cost / per_channel,
        start_cost=end.start_cost / per_channel,
        empty_cost=empty / per_channel,
        covariance=spread * jnp.linalg.pinv(best.normal, hermitian=True),
        steps=end.tried,
        result=result,
    )


def refine_pose(
    template: Splats,
    world_from_template: SE3,
    views: Views,
    *,
    size: float,
    reach: float,
    config: PhotometricConfig = PhotometricConfig(),
) -> PoseFit:
    """Poses of one object that make its render, before the backdrop, agree best with all photographs at once.

    `template` in its own frame; `world_from_template` [m] starts; `size` the object's diameter and `reach` how far
    behind the known surface it still shows, both in scene units.

    Levenberg–Marquardt on the tangent of SE(3) about the object's middle, 6 unknowns per start; derivatives in forward
    mode through the renderer, all starts and views in one program; Geman–McClure weights per pixel and channel; block
    means first, which widens the basin. Only the tiles near the object at its starts are rendered. Not for use under
    jit. A failure is a `result`, never an exception; not differentiable.

    Raises ValueError for shapes that do not fit and a `size` that is not positive.
    """
    _check(world_from_template, views, size, config)
    middle = jnp.mean(template.means, axis=0)
    template = eqx.tree_at(lambda splats: splats.means, template, template.means - middle)
    to_middle = SE3(SE3.identity(dtype=middle.dtype).quat, middle)
    poses = world_from_template @ to_middle
    tiles = _choose_tiles(template, poses, views, config)
    patches = _cut(views, tiles, config.render)
    cameras = cameras_at(views.camera, poses)
    reach, span = jnp.asarray(reach, middle.dtype), jnp.asarray(size, middle.dtype)
    # The same program does any number of steps.
    program = dataclasses.replace(config, steps=0)
    repeated = jnp.tile(tiles, (poses.xyz.shape[0], 1))
    for slack in _SLACKS:
        plan = plan_render(template, cameras, tiles=repeated, config=config.render, slack=slack)
        end, empty = _descend(template, poses, patches, span, reach, config.steps, plan=plan, config=program)
        if int(end.overflow) == 0:
            break
    fit = _verdict(end, poses, empty, jnp.sum(patches.valid))
    return eqx.tree_at(lambda fit: fit.poses, fit, fit.poses @ to_middle.inverse())


def _check(poses: SE3, views: Views, size: float, config: PhotometricConfig) -> None:
    """Static faults of the arguments of `refine_pose`."""
    if poses.xyz.ndim != 2 or poses.xyz.shape[0] == 0:
        raise ValueError(f"world_from_template: expected one axis of starts, got translations {poses.xyz.shape}")
    if views.camera.K.ndim != 3:
        raise ValueError(f"views: expected cameras batched over one axis, got intrinsics {views.camera.K.shape}")
    shape = (views.camera.K.shape[0], views.camera.height, views.camera.width)
    for name, array in (("target", views.target[..., 0]), ("backdrop", views.backdrop[..., 0])):
        if array.shape != shape:
            raise ValueError(f"views.{name}: expected [{shape} 3], got {array.shape}")
    for name, array in (("depth", views.depth), ("valid", views.valid)):
        if array.shape != shape:
            raise ValueError(f"views.{name}: expected {shape}, got {array.shape}")
    if not size > 0 or not np.isfinite(size):
        raise ValueError(f"size: expected a positive length in scene units, got {size}")
    if config.render.tile_size % config.coarse:
        raise ValueError(f"coarse: expected a divisor of the tile, {config.render.tile_size} px, got {config.coarse}")
