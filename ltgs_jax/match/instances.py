"""Which silhouettes of one visit are one object: where their cones of rays meet in front of what is known."""

from collections.abc import Sequence
from dataclasses import dataclass

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage
from scipy.spatial import cKDTree

from .hull import Cone, carve

_TOUCHING = np.ones((3, 3, 3), bool)
_NECKS = (0.4, 0.5, 0.6, 0.7)  # depth inside, over that of the deepest voxel, at which a body may be cut
_FINE = 5.0  # voxels; in bodies less deep, grid and noise would cut at the higher ones
_LEAST_CORE = 0.05  # volume of a core over that of the largest


@dataclass(frozen=True)
class MatchConfig:
    """How masks become instances, and instances identities."""

    samples: int = 48
    """Depths tried along each ray."""
    rays: int = 600
    """Rays tried in each silhouette region at most."""
    nearest: float = 0.25
    """Start of a ray, as a share of the depth of the known surface behind."""
    min_new: float = 0.3
    """Share of an instance's silhouette pixels that no larger instance explains, in at least one photograph."""


class Instance(eqx.Module):
    """One unexplained object of one visit: sample points of the volume it can occupy, and its outline per photograph.

    `regions` [v h w] for photographs of equal size is kept as a tuple of masks, since sizes may differ; `views` counts
    the photographs in whose silhouettes it lies.
    """

    points: Float[np.ndarray, "n 3"]
    regions: tuple[Bool[np.ndarray, "h w"], ...]
    views: int = eqx.field(static=True)


def _sample(
    cone: Cone, pixels: Int[np.ndarray, "q 2"], near: Float[np.ndarray, " q"], far: Float[np.ndarray, " q"], count: int
) -> Float[np.ndarray, "q s 3"]:
    """Points along the rays of pixels (row, column), at `count` depths from near to far."""
    depths = near[:, None] + (far - near)[:, None] * np.linspace(0, 1, count)
    homogeneous = np.stack([pixels[:, 1] + 0.5, pixels[:, 0] + 0.5, np.ones(len(pixels))], axis=-1)
    left, translation = cone.projection[:, :3], cone.projection[:, 3]
    scaled = homogeneous[:, None] * depths[..., None] - translation
    return np.linalg.solve(left, scaled.reshape(-1, 3).T).T.reshape(*depths.shape, 3)


def _meeting(
    cone: Cone, pixels: Int[np.ndarray, "q 2"], cones: Sequence[Cone], config: MatchConfig
) -> tuple[Float[np.ndarray, "m 3"], float]:
    """Points on one region's rays that another silhouette holds and no photograph contradicts, and their spacing.

    Twice: along the whole ray, then again as finely within the depths that were left.
    """
    pixels = pixels[:: max(1, len(pixels) // config.rays)]
    far = cone.depth[pixels[:, 0], pixels[:, 1]]
    near = config.nearest * far
    for _ in range(2):
        points = _sample(cone, pixels, near, far, config.samples)
        counts = carve(points.reshape(-1, 3), cones, tolerance=0.0).reshape(*points.shape[:2], 2)
        good = (counts[..., 0] >= 2) & (counts[..., 1] == 0)
        spacing = (far - near) / (config.samples - 1)
        hit = good.any(axis=1)
        if not hit.any():
            return np.zeros((0, 3)), 0.0
        first, last = good.argmax(axis=1), config.samples - 1 - good[:, ::-1].argmax(axis=1)
        survivors, step = points[good], float(np.median(spacing[hit]))
        low, high = near + (first - 1) * spacing, near + (last + 1) * spacing
        far = np.minimum(high, far)[hit]
        near, pixels = np.maximum(low, 1e-6)[hit], pixels[hit]
    return survivors, step


def find_instances(
    cones: Sequence[Cone],
    surface: Float[np.ndarray, "n 3"],
    *,
    config: MatchConfig = MatchConfig(),
) -> list[Instance]:
    """Objects that came, one for each place where silhouettes meet.

    Every pixel of every silhouette is followed along its ray in front of the known surface; a point stays when no
    photograph that sees it sees it beside a silhouette, and at least two see it inside one. Clusters of such points are
    instances. Where outlines of several objects cross, ghosts arise: an instance must explain pixels that no better one
    does, and touch the known `surface` (points) — things do not float. Silhouettes that no second photograph can see
    are taken alone, at the depth of their contact with the surface.
    """
    if not cones:
        return []
    labels = [ndimage.label(cone.silhouette, np.ones((3, 3)))[0] for cone in cones]
    candidates, steps = [], [0.0]
    tree = cKDTree(surface)
    for label, cone in zip(labels, cones, strict=True):
        for region in range(1, label.max() + 1):
            pixels = np.argwhere((label == region) & (cone.depth > 0))
            if len(pixels) == 0:
                continue
            points, step = _meeting(cone, pixels, cones, config)
            candidates.append(points)
            steps.append(step)
    points = np.concatenate([*candidates, np.zeros((0, 3))])
    found = []
    if len(points):
        for cluster in _clusters(points, max(steps)):
            views = sum(bool(region.any()) for region in _outlines(cluster, cones))
            distance = tree.query(cluster)[0]
            size = np.linalg.norm(np.ptp(cluster, axis=0)) + 1e-9
            found.append((views, -float(distance.min() / size), len(cluster), cluster))
    found.sort(key=lambda f: (f[0], f[2]), reverse=True)
    explained = [np.zeros_like(cone.silhouette) for cone in cones]
    instances = []
    for views, contact, _, cluster in found:
        regions = _regions_of(cluster, cones, labels)
        share = [
            (region & ~done).sum() / max(region.sum(), 1) if region.any() else 0.0
            for region, done in zip(regions, explained, strict=True)
        ]
        if max(share) < config.min_new or contact < -0.25:
            continue
        instances.append(Instance(cluster, tuple(regions), views))
        explained = [done | region for done, region in zip(explained, regions, strict=True)]
    instances += _alone(cones, labels, explained, config)
    return instances


def _clusters(points: Float[np.ndarray, "n 3"], spacing: float) -> list[Float[np.ndarray, "m 3"]]:
    """Points grouped by voxels that touch and are not linked by necks alone; voxel edge 1/100 of their extent, and no
    finer than their spacing."""
    low = points.min(axis=0)
    voxel = max(np.ptp(points, axis=0).max() / 100, 1.2 * spacing) + 1e-9
    index = np.floor((points - low) / voxel).astype(int) + 1
    solid = np.zeros(index.max(axis=0) + 2, bool)
    solid[tuple(index.T)] = True
    label = _bodies(solid)[tuple(index.T)]
    return [points[label == i] for i in range(1, label.max() + 1) if (label == i).any()]


def _bodies(solid: Bool[np.ndarray, "x y z"]) -> Int[np.ndarray, "x y z"]:
    """Each solid body with a label from 1 on: what touches, cut where it is much thinner than elsewhere.

    Shadows and remnants of what left link things that stand apart. A body is what lies around a core, no farther from
    it than the deepest voxel is deep; the rest is looked at in the same way.
    """
    bodies = np.zeros(solid.shape, int)
    waiting = _pieces(solid | ndimage.binary_closing(solid, _TOUCHING))
    while waiting:
        box, piece = waiting.pop()
        piece = np.pad(piece, 1)
        depth = ndimage.distance_transform_edt(piece)
        cores = _cores(depth)
        distance, nearest = ndimage.distance_transform_edt(cores == 0, return_indices=True)
        near = piece & (distance <= depth.max())
        owner = cores[tuple(nearest)]
        here = bodies[box]
        for core in range(1, cores.max() + 1):
            here[(near & (owner == core))[1:-1, 1:-1, 1:-1]] = bodies.max() + 1
        rest = (piece & ~near)[1:-1, 1:-1, 1:-1]
        waiting += [(_inside(box, part), mask) for part, mask in _pieces(rest)]
    return bodies


def _cores(depth: Float[np.ndarray, "x y z"]) -> Int[np.ndarray, "x y z"]:
    """The cores of a body by how deep inside each voxel is, numbered from 1: what hangs together at the least share of
    the greatest depth at which there are several, each a third deeper at its deepest than where they part; else one."""
    deepest = depth.max()
    for level in _NECKS if deepest > _FINE else _NECKS[:1]:
        label, count = ndimage.label(depth >= level * deepest, _TOUCHING)
        index = np.arange(1, count + 1)
        deep = ndimage.maximum(depth, label, index) >= 4 / 3 * level * deepest
        volume = ndimage.sum(label > 0, label, index)
        cores = index[deep & (volume >= _LEAST_CORE * volume.max())]
        if len(cores) > 1:
            number = np.zeros(count + 1, int)
            number[cores] = np.arange(1, len(cores) + 1)
            return number[label]
    label, _ = ndimage.label(depth >= _NECKS[0] * deepest, _TOUCHING)
    return (label == label.ravel()[depth.argmax()]).astype(int)


def _pieces(solid: Bool[np.ndarray, "x y z"]) -> list[tuple[tuple[slice, ...], Bool[np.ndarray, "a b c"]]]:
    """The box of each connected piece, and the piece in it."""
    label, _ = ndimage.label(solid, _TOUCHING)
    return [(box, label[box] == i + 1) for i, box in enumerate(ndimage.find_objects(label))]


def _inside(box: tuple[slice, ...], part: tuple[slice, ...]) -> tuple[slice, ...]:
    """A box within a box, in the coordinates of all."""
    return tuple(slice(b.start + p.start, b.start + p.stop) for b, p in zip(box, part, strict=True))


def _outlines(cluster: Float[np.ndarray, "n 3"], cones: Sequence[Cone]) -> list[Bool[np.ndarray, "h w"]]:
    """Pixels that the cluster's points fall on."""
    outlines = []
    homogeneous = np.concatenate([cluster, np.ones((len(cluster), 1))], axis=1)
    for cone in cones:
        x, y, z = (homogeneous @ cone.projection.T).T
        outline = np.zeros_like(cone.silhouette)
        h, w = outline.shape
        column, row = np.floor(x / np.maximum(z, 1e-6)).astype(int), np.floor(y / np.maximum(z, 1e-6)).astype(int)
        inside = (z > 1e-6) & (column >= 0) & (column < w) & (row >= 0) & (row < h)
        inside[inside] &= cone.silhouette[row[inside], column[inside]]
        outline[row[inside], column[inside]] = True
        outlines.append(outline)
    return outlines


def _regions_of(cluster, cones: Sequence[Cone], labels: Sequence[np.ndarray]) -> list[Bool[np.ndarray, "h w"]]:
    """The part of each silhouette that the cluster accounts for: its outline, closed, within the silhouette."""
    regions = []
    for outline, cone in zip(_outlines(cluster, cones), cones, strict=True):
        closed = ndimage.binary_dilation(outline, iterations=3) & cone.silhouette
        regions.append(ndimage.binary_fill_holes(closed) & cone.silhouette)
    return regions


def _alone(cones, labels, explained, config: MatchConfig) -> list[Instance]:
    """Silhouettes that no other photograph can see: the rays near the known surface at the region's nearer edge."""
    instances = []
    for v, (label, cone, done) in enumerate(zip(labels, cones, explained, strict=True)):
        for region in range(1, label.max() + 1):
            mask = (label == region) & (cone.depth > 0)
            if not mask.any() or (mask & done).sum() > 0.5 * mask.sum():
                continue
            contact = float(np.quantile(cone.depth[mask], 0.1))
            pixels = np.argwhere(mask)
            pixels = pixels[:: max(1, len(pixels) // config.rays)]
            far = np.minimum(cone.depth[pixels[:, 0], pixels[:, 1]], contact)
            points = _sample(cone, pixels, 0.95 * far, far, 4).reshape(-1, 3)
            others = [c for i, c in enumerate(cones) if i != v]
            counts = carve(points, others, tolerance=0.0)
            if counts[:, 1].mean() > 0.5:  # photographs that see the place say that nothing came
                continue
            regions = tuple(mask if i == v else np.zeros_like(c.silhouette) for i, c in enumerate(cones))
            instances.append(Instance(points, regions, 1))
    return instances
