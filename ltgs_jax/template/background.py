"""What lay hidden under an object: splats on its support, coloured from the surroundings until photographs show it."""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree

from ltgs_jax.geometry import C0, quat_from_rotmat
from ltgs_jax.scene import Splats

from .config import TemplateConfig
from .support import Support, convex_footprint


def flat_splats(
    points: Float[np.ndarray, "n 3"],
    colors: Float[np.ndarray, "n 3"],
    *,
    support: Support,
    spacing: float,
    opacity: float,
    coefficients: int,
) -> Splats:
    """Discs in the support's plane, `spacing` apart, at points with colours in 0…1."""
    frame = support.frame()
    rotmat = frame.T  # columns: the plane's axes and its normal, right-handed by construction
    n = len(points)
    sh = np.zeros((n, coefficients, 3), np.float32)
    sh[:, 0] = (colors - 0.5) / C0
    quat = quat_from_rotmat(jnp.asarray(rotmat, jnp.float32))
    scales = np.log([0.7 * spacing, 0.7 * spacing, 0.1 * spacing])
    return Splats(
        means=jnp.asarray(points, jnp.float32),
        quats=jnp.tile(quat, (n, 1)),
        log_scales=jnp.tile(jnp.asarray(scales, jnp.float32), (n, 1)),
        logit_opacities=jnp.full(n, np.log(opacity / (1 - opacity)), jnp.float32),
        sh=jnp.asarray(sh),
    )


def color_from_photographs(
    splats: Splats,
    projections: Sequence[Float[np.ndarray, "3 4"]],
    photographs: Sequence[Float[np.ndarray, "h w 3"]],
    *,
    agree: float = 0.08,
    near_guess: float = 0.2,
) -> tuple[Splats, Bool[np.ndarray, " n"]]:
    """Colours of bared ground from the photographs that show it, and which splats found one.

    Photographs must agree with each other within `agree`, or a single one with the guess within `near_guess` (in 0…1):
    what stands in front of the ground in one photograph does not in the others.
    """
    means = np.asarray(splats.means, np.float64)
    guess = np.asarray(splats.sh[:, 0]) * C0 + 0.5
    samples = np.full((len(projections), len(means), 3), np.nan)
    homogeneous = np.concatenate([means, np.ones((len(means), 1))], axis=1)
    for v, (projection, photograph) in enumerate(zip(projections, photographs, strict=True)):
        x, y, z = (homogeneous @ projection.T).T
        safe = np.where(z > 1e-6, z, 1)
        column, row = np.floor(x / safe).astype(int), np.floor(y / safe).astype(int)
        inside = (z > 1e-6) & (column >= 0) & (column < photograph.shape[1]) & (row >= 0) & (row < photograph.shape[0])
        samples[v, inside] = photograph[row[inside], column[inside]]
    colors, found = guess.copy(), np.zeros(len(means), bool)
    closest = np.full(len(means), np.inf)
    for a in range(len(samples)):
        for b in range(a + 1, len(samples)):
            apart = np.abs(samples[a] - samples[b]).max(axis=-1)
            middle = (samples[a] + samples[b]) / 2
            # Of the pairs that agree, the one nearest to the surroundings: two photographs may agree on an object too.
            away = np.where(apart < agree, np.abs(middle - guess).max(axis=-1), np.inf)
            better = away < closest
            colors[better], closest[better], found[better] = middle[better], away[better], True
    for sample in samples:
        away = np.abs(sample - guess).max(axis=-1)
        better = ~found & (away < np.minimum(near_guess, closest))
        colors[better], closest[better] = sample[better], away[better]
    found |= closest < near_guess
    sh = np.array(splats.sh)
    sh[:, 0] = (colors - 0.5) / C0
    return eqx.tree_at(lambda s: s.sh, splats, sh), found


def fill_under(
    background: Splats,
    removed: Float[np.ndarray, "m 3"],
    support: Support,
    *,
    config: TemplateConfig = TemplateConfig(),
) -> Splats:
    """Splats on the support under an object whose splat centres were `removed`, where the background has none.

    Colours are those of the support's splats around, weighted by distance: a guess, until the fit sees photographs.
    """
    frame = support.frame()
    means = np.asarray(background.means, np.float64)
    local = means @ frame.T
    low, high = (removed @ frame[:2].T).min(axis=0), (removed @ frame[:2].T).max(axis=0)
    size = np.linalg.norm(high - low)
    middle = (low + high) / 2
    around = np.linalg.norm(local[:, :2] - middle, axis=1) < 1.5 * size
    on_plane = around & (np.abs(support.height(means)) < 4 * support.noise + 0.02 * size)
    on_plane &= np.asarray(background.opacities) > 0.05
    if on_plane.sum() < 8:
        return background[np.zeros(background.count, bool)]
    ring = local[on_plane, :2]
    colors = np.clip(np.asarray(background.sh)[on_plane, 0] * C0 + 0.5, 0, 1)
    tree = cKDTree(ring)
    spacing = float(np.clip(np.median(tree.query(ring, k=2)[0][:, 1]), size / 60, size / 12))
    margin = 2 * spacing
    axes = [np.arange(a - margin, b + margin, spacing) for a, b in zip(low, high, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    footprint = (removed @ frame[:2].T - middle) * (1 + margin / size) + middle
    grid = grid[convex_footprint(footprint, grid)]
    widths = np.exp(np.sort(np.asarray(background.log_scales)[on_plane], axis=1)[:, 1])
    covered = np.zeros(len(grid))
    opacities = np.asarray(background.opacities)[on_plane]
    for i, neighbours in enumerate(tree.query_ball_point(grid, 3 * spacing)):
        if neighbours:
            distance = np.linalg.norm(ring[neighbours] - grid[i], axis=1)
            covered[i] = np.sum(opacities[neighbours] * np.exp(-0.5 * (distance / widths[neighbours]) ** 2))
    grid = grid[covered < 1.0]
    if len(grid) == 0:
        return background[np.zeros(background.count, bool)]
    grid = grid[:: max(1, -(-len(grid) // config.fill_splats))]
    distance, index = tree.query(grid, k=min(24, len(ring)))
    weight = 1 / (distance + 0.5 * spacing) ** 2
    blended = np.sum(colors[index] * weight[..., None], axis=1) / weight.sum(axis=1, keepdims=True)
    points = np.concatenate([grid, np.full((len(grid), 1), support.offset)], axis=1) @ frame
    return flat_splats(
        points,
        blended,
        support=support,
        spacing=spacing,
        opacity=0.95,
        coefficients=background.sh.shape[1],
    )
