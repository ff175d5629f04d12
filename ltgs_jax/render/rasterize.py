"""`render`: splats and a camera to an image, alpha and depth."""

import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ltgs_jax.geometry import Camera
from ltgs_jax.scene import Splats

from .binning import bin_splats
from .composite import composite
from .config import RenderConfig, RenderOutput, RenderPlan
from .grid import Grid
from .plan import batch_of, plan_render
from .project import project_splats
from .slots import Schedule, lay_out, make_table, tiles_per_block


@functools.partial(jax.jit, static_argnames=("plan", "config"))
def _render_planned(splats, cameras, background, tiles, colors, *, plan: RenderPlan, config: RenderConfig):
    """The whole program for a batch of cameras: every field with leading axes cameras, then tiles or rows."""
    dtype = splats.means.dtype
    grid = Grid(cameras.width, cameras.height, config.tile_size, cameras.K.shape[0])
    chosen, active = (None, None) if tiles is None else grid.choose(tiles)
    schedule = Schedule(
        tile_size=config.tile_size,
        chunk=config.chunk,
        tiles_per_block=tiles_per_block(config, grid.count if chosen is None else chosen.shape[0]),
        rounds=plan.rounds,
    )
    projected = project_splats(splats, cameras, near=config.near, colors=colors)
    bins = bin_splats(projected, grid, plan.intersections, active)
    slots = lay_out(bins, grid, chosen, schedule, projected.depths.shape[0], dtype)
    totals, transmittance = composite(schedule, make_table(projected), slots)

    def unblocked(values):
        values = values.reshape(-1, values.shape[-1])[: slots.order.shape[0]]
        values = jnp.zeros_like(values).at[slots.order].set(values, unique_indices=True)
        return values.reshape(grid.cameras, -1, config.tile_size, config.tile_size)

    *totals, total_depth = (unblocked(total) for total in totals)
    transmittance = unblocked(transmittance)
    if background is not None:
        # Channel by channel: the transpose of one product with [ch] is a sum along a short axis, slow on CPUs.
        background = background.astype(dtype)
        totals = [total + transmittance * background[j] for j, total in enumerate(totals)]
    image = jnp.stack(totals, axis=-1)
    alpha = 1 - transmittance
    covered = alpha > 0
    depth = jnp.where(covered, total_depth / jnp.where(covered, alpha, 1), 0)
    if tiles is None:
        image, alpha, depth = (_untile(v, grid) for v in (image, alpha, depth))
    return RenderOutput(image, alpha, depth, bins.overflow + slots.dropped)


def _untile(values: Float[Array, "c t s s *ch"], grid: Grid) -> Float[Array, "c h w *ch"]:
    """Tiles to images."""
    rest = values.shape[4:]
    values = values.reshape(grid.cameras, grid.rows, grid.columns, grid.tile_size, grid.tile_size, *rest)
    values = jnp.swapaxes(values, 2, 3)
    values = values.reshape(grid.cameras, grid.rows * grid.tile_size, grid.columns * grid.tile_size, *rest)
    return values[:, : grid.height, : grid.width]


def render(
    splats: Splats,
    camera: Camera,
    *,
    background: Float[Array, " ch"] | None = None,
    plan: RenderPlan | None = None,
    tiles: Int[Array, "*c t"] | None = None,
    colors: Float[Array, "n ch"] | None = None,
    config: RenderConfig | None = None,
) -> RenderOutput:
    """Render splats with one camera, or with each camera of a batch (then every field but `overflow` has its axis).

    `background` [ch] colour behind everything (default black); `colors` [n ch] replaces the evaluation of `sh` by any
    small number of channels (labels, features); `tiles` [t] (or [c t] with a batch) row-major indices of tiles of
    `config.tile_size` px: then only these are worked on, and fields are patches [t, tile_size, tile_size, …] instead of
    images; indices outside of the grid (say −1) are padding and give background. `camera` must not be batched deeper
    than once.

    Without a `plan`, one is made by a counting pass whose bound holds for these very splats, so that nothing overflows;
    under jit and other transformations that hide values a plan is required, and the caller watches `overflow`.

    Differentiable in splats, camera, background and colours, in reverse and in forward mode; not where a splat crosses
    α = 1/255, α = 0.99, transmittance 1e-4 or the near plane, nor in the order of depths.

    Raises ValueError for shapes that do not fit and for a missing plan under a transformation.
    """
    config = config or RenderConfig()
    _check(splats, camera, background, colors, tiles)
    cameras = batch_of(camera)
    batch_tiles = tiles if tiles is None or camera.K.ndim == 3 else tiles[None]
    if plan is None:
        plan = plan_render(*jax.lax.stop_gradient((splats, camera)), tiles=tiles, config=config, slack=1)
    output = _render_planned(splats, cameras, background, batch_tiles, colors, plan=plan, config=config)
    if camera.K.ndim == 3:
        return output
    return RenderOutput(output.image[0], output.alpha[0], output.depth[0], output.overflow)


def _check(splats: Splats, camera: Camera, background, colors, tiles) -> None:
    """Static faults of the arguments of `render`."""
    if camera.K.ndim not in (2, 3):
        raise ValueError(f"camera: expected one camera or one batch axis, got intrinsics of shape {camera.K.shape}")
    if camera.width < 1 or camera.height < 1:
        raise ValueError(f"camera: expected an image of at least 1×1, got {camera.width}×{camera.height}")
    channels = 3
    if colors is not None:
        if colors.ndim != 2 or colors.shape[0] != splats.count:
            raise ValueError(f"colors: expected [{splats.count} ch], got {colors.shape}")
        channels = colors.shape[1]
    if background is not None and background.shape != (channels,):
        raise ValueError(f"background: expected [{channels}], got {background.shape}")
    if tiles is not None and tiles.ndim != camera.K.ndim - 1:
        raise ValueError(f"tiles: expected {camera.K.ndim - 1} axes for this camera, got shape {tiles.shape}")


def splat_votes(
    splats: Splats,
    camera: Camera,
    values: Float[Array, "*c h w m"],
    *,
    plan: RenderPlan | None = None,
    config: RenderConfig | None = None,
) -> Float[Array, "n m"]:
    """Σ over pixels of weight αT times value, for every splat: how much of each value a splat painted.

    This is FlashSplat's A_n (Shen et al. 2024) for values that are one-hot masks, and the vector-Jacobian product of
    the renderer with respect to colours (fact 10 of the conventions). A batch of cameras is summed.
    """
    splats, camera = jax.lax.stop_gradient((splats, camera))
    config = config or RenderConfig()
    if plan is None:
        plan = plan_render(splats, camera, config=config, slack=1)
    blank = jnp.zeros((splats.count, values.shape[-1]), splats.means.dtype)
    _, pull = jax.vjp(lambda colors: render(splats, camera, plan=plan, colors=colors, config=config).image, blank)
    return pull(values.astype(splats.means.dtype))[0]
