"""Static capacities, from a counting pass."""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from ltgs_jax.geometry import Camera
from ltgs_jax.scene import Splats

from .config import RenderConfig, RenderPlan
from .grid import Grid, count_boxes, drop_inactive, tile_boxes
from .project import project_splats
from .slots import block_rounds, tiles_per_block

# Plans made so far by the kind of program: reusing one saves a compilation, and the result does not depend on it.
_made: dict[tuple, set[RenderPlan]] = {}


def _settle(kind: tuple, pairs: int, rounds: int, slack: float) -> RenderPlan:
    """A plan with room for so many pairs and rounds: the smallest made before that fits without waste, or a new one.

    One made before need not have all of `slack` to spare.
    """
    plans = _made.setdefault(kind, set())
    least, most = min(slack, 1.2), 2 * slack
    fits = [
        plan
        for plan in plans
        if least * pairs <= plan.intersections <= most * max(pairs, 8192)
        and least * rounds <= plan.rounds <= most * max(rounds, 16)
    ]
    if fits:
        return min(fits, key=lambda plan: (plan.intersections, plan.rounds))
    plan = RenderPlan(_round_up(slack * pairs, 1024), _round_up(slack * rounds, 16))
    plans.add(plan)
    return plan


def batch_of(camera: Camera) -> Camera:
    """A camera as a batch of one; a batch as it is."""
    return camera if camera.K.ndim == 3 else jax.tree.map(lambda leaf: leaf[None], camera)


def _round_up(count: float, least: int) -> int:
    """The next of the sizes 4, 5, 6, 7 times a power of two: few sizes, few compilations."""
    count = max(least, math.ceil(count))
    step = 1 << (count.bit_length() - 3)
    return -(-count // step) * step


@functools.partial(jax.jit, static_argnames=("config",))
def _count(splats: Splats, cameras: Camera, tiles, *, config: RenderConfig) -> tuple[Int[Array, ""], Int[Array, ""]]:
    """Pairs of splat and tile by bounding box, and the rounds that they need: upper bounds of what rendering finds."""
    projected = jax.lax.stop_gradient(project_splats(splats, cameras, near=config.near))
    grid = Grid(cameras.width, cameras.height, config.tile_size, cameras.K.shape[0])
    boxes = tile_boxes(projected, grid)
    chosen = None
    if tiles is not None:
        chosen, active = grid.choose(tiles)
        boxes = drop_inactive(boxes, grid, active)
    counts = count_boxes(boxes, grid)
    if chosen is not None:
        counts = jnp.where(chosen >= 0, counts[chosen], 0)
    _, rounds = block_rounds(counts, tiles_per_block(config, counts.shape[0]), config.chunk)
    with jax.enable_x64(True):
        pairs = jnp.sum((boxes[:, 2] - boxes[:, 0]).astype(jnp.int64) * (boxes[:, 3] - boxes[:, 1]).astype(jnp.int64))
    return pairs, jnp.sum(rounds)


def plan_render(
    splats: Splats,
    camera: Camera,
    *,
    tiles: Int[Array, "*c t"] | None = None,
    config: RenderConfig | None = None,
    slack: float = 1.3,
) -> RenderPlan:
    """Static capacities for `render` of these splats by this camera, or by all of a batch at once.

    Counts bounding boxes, which bounds the exact tests of `render` from above: with `slack` 1 the plan holds for these
    splats and this camera. `slack` is the factor of room for splats that move or grow before the next plan; `tiles` as
    for `render`. Not for use under jit.

    Raises ValueError when `slack` is below 1, when a camera holds a number that is not finite, or under a
    transformation that hides the values.
    """
    config = config or RenderConfig()
    if slack < 1:
        raise ValueError(f"slack: expected at least 1, got {slack}")
    if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves((splats, camera, tiles))):
        raise ValueError("plan: expected a RenderPlan under jit or another transformation; make one with plan_render")
    cameras = batch_of(camera)
    for leaf in jax.tree.leaves(cameras):
        if not np.all(np.isfinite(leaf)):
            raise ValueError("camera: expected finite poses and intrinsics, got NaN or infinity")
    if splats.count == 0:
        return RenderPlan(intersections=1024, rounds=16)
    kind = (splats.count, cameras.K.shape[0], cameras.width, cameras.height, config, tiles is None or tiles.shape)
    batch_tiles = tiles if tiles is None or camera.K.ndim == 3 else tiles[None]
    pairs, rounds = _count(splats, cameras, batch_tiles, config=config)
    return _settle(kind, int(pairs), int(rounds), slack)
