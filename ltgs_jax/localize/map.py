"""The frozen map: photographs of known pose, their keypoints, and the points that these see."""

import dataclasses

import numpy as np
from jaxtyping import Float, Int

from ltgs_jax.features import match_indices

from .tracks import Member, join_tracks, triangulate


@dataclasses.dataclass(frozen=True)
class View:
    """A photograph of known pose: `K` [3 3] px, `cam_from_world` [3 4], keypoints, and the visit it belongs to."""

    name: str
    visit: int
    K: Float[np.ndarray, "3 3"]
    cam_from_world: Float[np.ndarray, "3 4"]
    xy: Float[np.ndarray, "m 2"]
    descriptors: Float[np.ndarray, "m d"]

    def center(self) -> Float[np.ndarray, "3"]:
        """Camera centre in the world."""
        return -self.cam_from_world[:, :3].T @ self.cam_from_world[:, 3]

    def rays(self) -> Float[np.ndarray, "m 2"]:
        """Normalised image coordinates of the keypoints."""
        return (self.xy - self.K[:2, 2]) / np.diag(self.K)[:2]


Match = tuple[float, Member, Member]


@dataclasses.dataclass(frozen=True)
class FrozenMap:
    """Views, points [p 3], for each view the point of each of its keypoints (-1: none), and the matches behind them."""

    views: tuple[View, ...]
    points: Float[np.ndarray, "p 3"]
    point_of: tuple[Int[np.ndarray, " m"], ...]
    matches: tuple[Match, ...]


def fundamental(a: View, b: View) -> Float[np.ndarray, "3 3"]:
    """F of two views of known pose, x_bᵀ·F·x_a = 0 in pixels."""
    rotation = b.cam_from_world[:, :3] @ a.cam_from_world[:, :3].T
    x, y, z = b.cam_from_world[:, 3] - rotation @ a.cam_from_world[:, 3]
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.linalg.inv(b.K).T @ cross @ rotation @ np.linalg.inv(a.K)


def _neighbours(views: tuple[View, ...], *, count: int) -> list[list[int]]:
    """For each view those nearest in place that look the same way."""
    centers = np.stack([view.center() for view in views])
    forward = np.stack([view.cam_from_world[2, :3] for view in views])
    distance = np.linalg.norm(centers[:, None] - centers[None], axis=-1)
    spread = np.median(distance[distance > 0]) if (distance > 0).any() else 1.0
    # Half a turn costs as much as one median distance between cameras.
    cost = distance / spread + np.arccos(np.clip(forward @ forward.T, -1, 1)) / np.pi
    chosen = []
    for i in range(len(views)):
        order = [j for j in np.argsort(cost[i], kind="stable").tolist() if j != i]
        # The nearest have the surest matches but the smallest angles: take also every third of the next ones.
        chosen.append(order[:count] + order[count : 4 * count : 3])
    return chosen


def extend_map(
    frozen: FrozenMap | None,
    new_views: tuple[View, ...],
    *,
    neighbours: int = 4,
    epipolar_px: float = 2.0,
    max_error_px: float = 2.5,
) -> FrozenMap:
    """A map with more views: these are matched along epipolar lines, then all points triangulated afresh.

    Poses stay as they are. `neighbours` of each new view are matched, and as many again further away; the views of a
    point must agree within `max_error_px` and see it under at least 1.5°.
    """
    views = (frozen.views if frozen else ()) + new_views
    matches = list(frozen.matches) if frozen else []
    is_new = range(len(views) - len(new_views), len(views))
    nearest = _neighbours(views, count=neighbours)
    pairs = sorted({(min(i, j), max(i, j)) for i in is_new for j in nearest[i]})
    for i, j in pairs:
        a, b = views[i], views[j]
        rows, columns, score = match_indices(
            (a.xy, a.descriptors), (b.xy, b.descriptors), fundamental=fundamental(a, b), epipolar_px=epipolar_px
        )
        matches += [
            (s, (i, p), (j, q)) for s, p, q in zip(score.tolist(), rows.tolist(), columns.tolist(), strict=True)
        ]
    rays = [view.rays() for view in views]
    point_of = [np.full(len(view.xy), -1) for view in views]
    points = []
    for group in join_tracks(matches):
        focal = np.mean([views[i].K[0, 0] for i, _ in group])
        found = triangulate(
            np.stack([views[i].cam_from_world for i, _ in group]),
            np.stack([rays[i][p] for i, p in group]),
            max_error=max_error_px / focal,
            min_angle=np.deg2rad(1.5),
        )
        if found is not None:
            point, kept = found
            for i, p in (group[member] for member in kept):
                point_of[i][p] = len(points)
            points.append(point)
    return FrozenMap(views, np.array(points).reshape(-1, 3), tuple(point_of), tuple(matches))
