"""What lay hidden under an object: splats on its support, coloured from the surroundings until photographs show it."""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from ltgs_jax.geometry import C0, quat_from_rotmat, rotmat_from_quat
from ltgs_jax.scene import Splats

from .config import TemplateConfig
from .support import Support, convex_footprint

_RADIUS = 0.7  # standard deviation of a disc of ground, in spacings of their grid


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
    scales = np.log([_RADIUS * spacing, _RADIUS * spacing, 0.1 * spacing])
    return Splats(
        means=jnp.asarray(points, jnp.float32),
        quats=jnp.tile(quat, (n, 1)),
        log_scales=jnp.tile(jnp.asarray(scales, jnp.float32), (n, 1)),
        logit_opacities=jnp.full(n, np.log(opacity / (1 - opacity)), jnp.float32),
        sh=jnp.asarray(sh),
    )


def coarser(
    splats: Splats, since: Int[np.ndarray, " n"], *, alike: float = 0.12, levels: int = 2
) -> tuple[Splats, Int[np.ndarray, " n"]]:
    """Squares of four `flat_splats` of one grid as one disc of twice the size, where their colours agree within `alike`
    (in 0…1), and those again; and for each splat that was given, the row it became part of. `since`: the visit from
    which on each shows; those of different visits stay apart.

    A quadtree: a grid fine enough for the print of what it shows is finer than bare ground needs.
    """
    row = np.arange(splats.count)
    for _ in range(levels):
        group = _squares(splats, since, alike)
        first = np.unique(group, return_index=True)[1]
        count = np.bincount(group)

        def mean(leaf, group=group, count=count):
            columns = np.asarray(leaf, np.float64).reshape(len(leaf), -1).T
            return (np.stack([np.bincount(group, column) for column in columns]) / count).T

        merged = splats[first]
        grown = np.log(np.where(count == 4, 2, 1))[:, None] * np.array([1, 1, 0])
        splats = Splats(
            means=mean(splats.means).astype(np.float32),
            quats=merged.quats,
            log_scales=(merged.log_scales + grown).astype(np.float32),
            logit_opacities=merged.logit_opacities,
            sh=mean(splats.sh).reshape(merged.sh.shape).astype(np.float32),
        )
        row, since = group[row], since[first]
    return splats, row


def _squares(splats: Splats, since: Int[np.ndarray, " n"], alike: float) -> Int[np.ndarray, " n"]:
    """The square of four alike neighbours that each disc is in, by number; one of its own where there are no four."""
    quats, logs = np.asarray(splats.quats), np.asarray(splats.log_scales)
    spacing = np.exp(logs[:, :1]).astype(np.float64) / _RADIUS
    axes = np.asarray(rotmat_from_quat(jnp.asarray(quats)), np.float64)
    local = np.einsum("nji,nj->ni", axes, np.asarray(splats.means, np.float64)) / spacing
    alike_in = np.column_stack([since, quats, logs, local[:, 2] / 4])
    kind = np.unique(np.round(alike_in, 3), axis=0, return_inverse=True)[1].ravel()
    low = np.full((kind.max(initial=0) + 1, 2), np.inf)
    np.minimum.at(low, kind, local[:, :2])
    # Of two by two grid points; the quarter keeps them off the cells' borders.
    cell = np.floor((local[:, :2] - low[kind] + 0.25) / 2).astype(int)
    group = np.unique(np.column_stack([kind, cell]), axis=0, return_inverse=True)[1].ravel()
    colors = np.asarray(splats.sh)[:, 0] * C0
    most, least = np.full((group.max(initial=0) + 1, 3), -np.inf), np.full((group.max(initial=0) + 1, 3), np.inf)
    np.maximum.at(most, group, colors)
    np.minimum.at(least, group, colors)
    whole = (np.bincount(group) == 4) & ((most - least).max(axis=1) <= alike)
    alone = ~whole[group]
    group = np.where(alone, group.max(initial=0) + 1 + np.arange(len(group)), group)
    return np.unique(group, return_inverse=True)[1].ravel()


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
    if on_plane.sum() < 8 or config.fill_splats == 0:
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
