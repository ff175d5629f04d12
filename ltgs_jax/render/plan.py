"""Static capacities, from a counting pass."""

import functools
import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ltgs_jax.geometry import Camera
from ltgs_jax.scene import Splats

from .binning import Grid, tile_boxes
from .config import RenderConfig, RenderPlan
from .project import Projected, project_splats


def tiles_per_block(config: RenderConfig, tiles: int) -> int:
    """Tiles that advance together: few on a CPU, where a block stays in the cache; all on other devices."""
    wanted = config.tiles_per_block
    if wanted is None:
        wanted = 128 if jax.default_backend() == "cpu" else tiles
    return max(1, min(wanted, tiles))


def batch_of(camera: Camera) -> Camera:
    """A camera as a batch of one; a batch as it is."""
    return camera if camera.K.ndim == 3 else jax.tree.map(lambda leaf: leaf[None], camera)


def project_batch(
    splats: Splats, cameras: Camera, *, near: float, colors: Float[Array, "n ch"] | None = None
) -> Projected:
    """Project into every camera; the fields of camera i are rows i·n … (i+1)·n."""
    projected = jax.vmap(lambda camera: project_splats(splats, camera, near=near, colors=colors))(cameras)
    return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), projected)


def _round_up(count: float, least: int) -> int:
    """The next of the sizes 4, 5, 6, 7 times a power of two: few sizes, few compilations."""
    count = max(least, math.ceil(count))
    step = 1 << (count.bit_length() - 3)
    return -(-count // step) * step


def block_rounds(counts: Int[Array, " tiles"], block: int, chunk: int) -> tuple[Int[Array, " tiles"], Int[Array, " b"]]:
    """Tiles by decreasing count, padded to whole blocks (with index `tiles`), and the rounds of each block."""
    tiles = counts.shape[0]
    padding = -tiles % block
    with jax.enable_x64(True):
        inverse = jnp.uint64(0xFFFFFFFF) - counts.astype(jnp.uint64)
        packed = jnp.sort((inverse << jnp.uint64(32)) | jnp.arange(tiles, dtype=jnp.uint64))
        order = (packed & jnp.uint64(0xFFFFFFFF)).astype(jnp.int32)
    order = jnp.concatenate([order, jnp.full(padding, tiles, jnp.int32)])
    return order, -(-counts[order[::block]] // chunk)


@functools.partial(jax.jit, static_argnames=("config",))
def _count(splats: Splats, cameras: Camera, *, config: RenderConfig) -> tuple[Float[Array, ""], Int[Array, ""]]:
    """Pairs of splat and tile by bounding box, and the rounds that they need: upper bounds of what rendering finds."""
    projected = jax.lax.stop_gradient(project_batch(splats, cameras, near=config.near))
    grid = Grid(cameras.width, cameras.height, config.tile_size, cameras.K.shape[0])
    boxes = tile_boxes(projected, grid)
    pairs = (boxes[:, 2] - boxes[:, 0]).astype(jnp.float32) * (boxes[:, 3] - boxes[:, 1]).astype(jnp.float32)
    camera = jnp.repeat(jnp.arange(grid.cameras, dtype=jnp.int32), splats.count)
    # A box adds one to the tiles it covers: four corners, then sums along both axes.
    corners = jnp.zeros((grid.cameras, grid.rows + 1, grid.columns + 1), jnp.int32)
    for row, column, sign in ((1, 0, 1), (1, 2, -1), (3, 0, -1), (3, 2, 1)):
        corners = corners.at[camera, boxes[:, row], boxes[:, column]].add(sign)
    counts = jnp.cumsum(jnp.cumsum(corners, axis=1), axis=2)[:, :-1, :-1].reshape(-1)
    _, rounds = block_rounds(counts, tiles_per_block(config, grid.count), config.chunk)
    return jnp.sum(pairs), jnp.sum(rounds)


def plan_render(
    splats: Splats, camera: Camera, *, config: RenderConfig | None = None, slack: float = 1.3
) -> RenderPlan:
    """Static capacities for `render` of these splats by this camera, or by each of a batch at once.

    `slack` is the factor of room for splats that move or grow before the next plan. Not for use under jit.

    Raises ValueError when `slack` is below 1, when a camera holds a number that is not finite, or under a
    transformation that hides the values.
    """
    config = config or RenderConfig()
    if slack < 1:
        raise ValueError(f"slack: expected at least 1, got {slack}")
    leaves = jax.tree.leaves((splats, camera))
    if any(isinstance(leaf, jax.core.Tracer) for leaf in leaves):
        raise ValueError("plan: expected a RenderPlan under jit or another transformation; make one with plan_render")
    cameras = batch_of(camera)
    for leaf in jax.tree.leaves(cameras):
        if not bool(jnp.all(jnp.isfinite(leaf))):
            raise ValueError("camera: expected finite poses and intrinsics, got NaN or infinity")
    if splats.count == 0:
        return RenderPlan(intersections=1024, rounds=1)
    pairs, rounds = _count(splats, cameras, config=config)
    return RenderPlan(_round_up(float(pairs) * slack, 1024), _round_up(int(rounds) * slack, 16))
