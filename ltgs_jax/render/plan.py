"""Static capacities, from a counting pass."""

import functools
import math

import jax
import numpy as np
from jaxtyping import Array, Int

from ltgs_jax.geometry import Camera
from ltgs_jax.scene import Splats

from .config import RenderConfig, RenderPlan
from .grid import Grid, drop_inactive, tile_boxes
from .project import project_splats
from .slots import tiles_per_block

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


@functools.partial(jax.jit, static_argnames=("grid", "config"))
def _boxes(splats: Splats, cameras: Camera, active, *, grid: Grid, config: RenderConfig) -> Int[Array, "m 4"]:
    """The box of tiles of every splat in every camera; those without an `active` tile are empty."""
    boxes = tile_boxes(project_splats(splats, cameras, near=config.near), grid)
    return boxes if active is None else drop_inactive(boxes, grid, active)


def _count(splats: Splats, cameras: Camera, tiles, config: RenderConfig) -> tuple[int, int]:
    """Pairs of splat and tile by bounding box, and the rounds that they need: upper bounds of what rendering finds.

    Boxes are counted on the host: for each new shape of splats, sorts and scatters would take XLA seconds to compile.
    """
    grid = Grid(cameras.width, cameras.height, config.tile_size, cameras.K.shape[0])
    chosen, active = (None, None) if tiles is None else grid.choose(tiles)
    boxes = np.asarray(_boxes(splats, cameras, active, grid=grid, config=config)).astype(np.int64)
    counts = _count_boxes(boxes, grid)
    if chosen is not None:
        chosen = np.asarray(chosen)
        counts = np.where(chosen >= 0, counts[chosen], 0)
    longest = np.sort(counts)[::-1][:: tiles_per_block(config, len(counts))]
    pairs = ((boxes[:, 2] - boxes[:, 0]) * (boxes[:, 3] - boxes[:, 1])).sum()
    return int(pairs), int((-(-longest // config.chunk)).sum())


def _count_boxes(boxes: Int[np.ndarray, "m 4"], grid: Grid) -> Int[np.ndarray, " tiles"]:
    """How many boxes cover each tile: a box adds one at two of its corners and takes one at the others, then sums."""
    shape = grid.cameras, grid.rows + 1, grid.columns + 1
    first = np.repeat(np.arange(grid.cameras), len(boxes) // grid.cameras) * (shape[1] * shape[2])
    corners = np.zeros(shape, np.int64)
    for row, column, sign in ((1, 0, 1), (1, 2, -1), (3, 0, -1), (3, 2, 1)):
        place = first + boxes[:, row] * shape[2] + boxes[:, column]
        corners += sign * np.bincount(place, minlength=corners.size).reshape(shape)
    return corners.cumsum(axis=1).cumsum(axis=2)[:, :-1, :-1].reshape(-1)


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
    return _settle(kind, *_count(splats, cameras, batch_tiles, config), slack)
