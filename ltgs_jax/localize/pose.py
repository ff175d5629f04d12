"""Camera pose of one photograph against the frozen map: hypotheses by RANSAC, then growth along the prediction."""

import zlib  # noqa: F401, I001  (before pycolmap, whose own zlib otherwise takes over the process and aborts it)
import dataclasses

import numpy as np
import pycolmap
from jaxtyping import Bool, Float, Int

from .affine import Keypoints
from .map import FrozenMap, View

_SAME_PLACE_PX = 2.0  # SIFT repeats a keypoint for each orientation, ASIFT for each view


@dataclasses.dataclass(frozen=True)
class Candidates:
    """Possible 2D-3D matches of one photograph: `keypoints` [k], `points` [k] and `views` [k] are indices, `cosines`
    [k]; `strong` [k] those that are mutual and pass the ratio test, the others are merely the best of their point."""

    keypoints: Int[np.ndarray, " k"]
    points: Int[np.ndarray, " k"]
    views: Int[np.ndarray, " k"]
    cosines: Float[np.ndarray, " k"]
    strong: Bool[np.ndarray, " k"]

    def subset(self, index: Int[np.ndarray, " i"]) -> "Candidates":
        """Some of them, in that order."""
        return Candidates(
            self.keypoints[index], self.points[index], self.views[index], self.cosines[index], self.strong[index]
        )


@dataclasses.dataclass(frozen=True)
class PoseEstimate:
    """A pose and what speaks for it.

    `keypoints`, `points` [i] the pairs within the final radius; `support` Σ(1 − (d/radius)²) over them; `ratio` the
    share of agreeing strong matches in the view of the map where that is largest; `residual` px, median; `K` with the
    focal length as refined.
    """

    cam_from_world: Float[np.ndarray, "3 4"]
    K: Float[np.ndarray, "3 3"]
    keypoints: Int[np.ndarray, " i"]
    points: Int[np.ndarray, " i"]
    support: float
    ratio: float
    residual: float

    @property
    def inliers(self) -> int:
        """How many points agree."""
        return len(self.points)

    def center(self) -> Float[np.ndarray, "3"]:
        """Camera centre in the world."""
        return -self.cam_from_world[:, :3].T @ self.cam_from_world[:, 3]


def find_candidates(
    query: Keypoints, frozen: FrozenMap, views: list[int], *, max_ratio: float, min_cosine: float
) -> Candidates:
    """Match a photograph's keypoints with some views of the map; each point and place in the photograph comes once."""
    xy, descriptors = query
    tables = [np.zeros((0, 5))]
    for index in views:
        view, point_of = frozen.views[index], frozen.point_of[index]
        seen = np.flatnonzero(point_of >= 0)
        if len(seen) == 0 or len(xy) == 0:
            continue
        cosine = descriptors @ view.descriptors.T
        best = np.argmax(cosine[:, seen], axis=0)
        strong = _strong_matches(cosine, xy, view, best, seen, max_ratio=max_ratio)
        where = np.full(len(seen), index)
        tables.append(np.stack([best, point_of[seen], where, cosine[best, seen], strong], axis=1))
    table = np.concatenate(tables)
    table = table[table[:, 3] >= min_cosine]
    table = table[np.lexsort((-table[:, 3], -table[:, 4]))]
    index = table[:, :3].astype(int)
    return Candidates(index[:, 0], index[:, 1], index[:, 2], table[:, 3], table[:, 4] > 0)


def _strong_matches(
    cosine: Float[np.ndarray, "m n"],
    xy: Float[np.ndarray, "m 2"],
    view: View,
    rows: Int[np.ndarray, " k"],
    columns: Int[np.ndarray, " k"],
    *,
    max_ratio: float,
) -> Bool[np.ndarray, " k"]:
    """Which matches of a photograph's keypoint with a view's are mutual and distinct in the view."""
    score = cosine[rows, columns]
    mutual = np.linalg.norm(view.xy[np.argmax(cosine[rows], axis=1)] - view.xy[columns], axis=1) < 1.5
    distinct = np.zeros(len(rows), bool)
    chosen = np.flatnonzero(mutual)
    if len(chosen):
        rivals = cosine[rows[chosen]]
        top = np.argpartition(-rivals, min(5, rivals.shape[1] - 1), axis=1)[:, :6]
        elsewhere = np.linalg.norm(view.xy[top] - view.xy[columns[chosen]][:, None], axis=-1) >= 1.5
        runner_up = np.max(np.where(elsewhere, np.take_along_axis(rivals, top, axis=1), -1), axis=1)
        near, far = np.maximum(1 - score[chosen], 0), np.maximum(1 - runner_up, 0)
        distinct[chosen] = np.sqrt(near) <= max_ratio * np.sqrt(far)
    return distinct


def _distinct(candidates: Candidates, query: Keypoints, index: Int[np.ndarray, " i"]) -> Int[np.ndarray, " k"]:
    """Of some candidates, in order of preference, the first of every point and of every place in the photograph."""
    _, first = np.unique(candidates.points[index], return_index=True)
    index = index[np.sort(first)]
    place = np.round(query[0][candidates.keypoints[index]] / _SAME_PLACE_PX)
    _, first = np.unique(place, axis=0, return_index=True)
    return index[np.sort(first)]


def _camera(K: Float[np.ndarray, "3 3"], size: tuple[int, int]) -> pycolmap.Camera:
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    model, params = ("SIMPLE_PINHOLE", [fx, cx, cy]) if fx == fy else ("PINHOLE", [fx, fy, cx, cy])
    return pycolmap.Camera(model=model, width=size[0], height=size[1], params=params)


def with_focal(K: Float[np.ndarray, "3 3"], focal: float) -> Float[np.ndarray, "3 3"]:
    """K with another focal length, its aspect kept."""
    scaled = K.copy()
    scaled[0, 0], scaled[1, 1] = focal, focal * K[1, 1] / K[0, 0]
    return scaled


def _project(
    points: Float[np.ndarray, "k 3"], cam_from_world: Float[np.ndarray, "3 4"], K: Float[np.ndarray, "3 3"]
) -> tuple[Float[np.ndarray, "k 2"], Bool[np.ndarray, " k"]]:
    """Pixels of points, and which of them lie in front."""
    local = points @ cam_from_world[:, :3].T + cam_from_world[:, 3]
    front = local[:, 2] > 1e-9 * np.abs(local).max(initial=1e-30)
    z = np.where(front, local[:, 2], 1)
    return local[:, :2] / z[:, None] * np.diag(K)[:2] + K[:2, 2], front


def _ransac(xy, points, K, size, *, max_error: float, trials: int, seed: int):
    """The pose with most agreeing pairs, and which these are; None when there is none."""
    options = pycolmap.AbsolutePoseEstimationOptions()
    options.ransac.max_error = max_error
    options.ransac.random_seed = seed
    options.ransac.min_inlier_ratio = 0.01
    options.ransac.min_num_trials = min(1000, trials)
    options.ransac.max_num_trials = trials
    found = pycolmap.estimate_absolute_pose(xy.astype(np.float64), points, _camera(K, size), options)
    if found is None:
        return None
    return found["cam_from_world"].matrix(), np.asarray(found["inlier_mask"], bool)


def _refine(xy, points, cam_from_world, K, size, *, refine_focal: bool):
    """Least squares on pixels with a Cauchy loss; the pose and K."""
    options = pycolmap.AbsolutePoseRefinementOptions()
    options.refine_focal_length = refine_focal
    camera = _camera(K, size)
    start = pycolmap.Rigid3d(cam_from_world)
    every = np.ones(len(xy), bool)
    found = pycolmap.refine_absolute_pose(start, xy.astype(np.float64), points, every, camera, options)
    if found is None:
        return cam_from_world, K
    return found["cam_from_world"].matrix(), with_focal(K, camera.params[0])


def _near(
    candidates: Candidates, query: Keypoints, frozen: FrozenMap, pose, K, *, radius: float
) -> tuple[Int[np.ndarray, " i"], Float[np.ndarray, " i"]]:
    """Candidates within `radius` px of their point's projection, one per point and per place, and their distances."""
    pixels, front = _project(frozen.points[candidates.points], pose, K)
    distance = np.where(front, np.linalg.norm(pixels - query[0][candidates.keypoints], axis=1), np.inf)
    chosen = np.flatnonzero(distance <= radius)
    chosen = chosen[np.argsort(-candidates.cosines[chosen], kind="stable")]
    chosen = _distinct(candidates, query, chosen)
    return chosen, distance[chosen]


def _best_view_ratio(candidates: Candidates, agreeing: Bool[np.ndarray, " k"], *, least: int = 5) -> float:
    """Share of strong matches that agree, in the view of the map where it is largest among those with `least`."""
    strong = candidates.views[candidates.strong]
    if len(strong) == 0:
        return 0.0
    total = np.bincount(strong)
    agreed = np.bincount(candidates.views[candidates.strong & agreeing], minlength=len(total))
    return float(np.max(np.where(agreed >= least, agreed / np.maximum(total, 1), 0)))


def grow_pose(
    candidates: Candidates,
    query: Keypoints,
    frozen: FrozenMap,
    pose: Float[np.ndarray, "3 4"],
    K: Float[np.ndarray, "3 3"],
    size: tuple[int, int],
    *,
    refine_focal: bool,
    final_px: float = 3.0,
) -> PoseEstimate | None:
    """Refine a rough pose on ever more candidates ever nearer to their prediction; None when fewer than 6 remain.

    A candidate is a point's best keypoint of the whole photograph, so that one lies within 3 px of its prediction by
    chance once in some thousands: the count of those that do is the evidence.
    """
    for radius in (16.0, 10.0, 6.0, 4.0, final_px):
        chosen, _ = _near(candidates, query, frozen, pose, K, radius=radius)
        if len(chosen) < 6:
            return None
        xy, points = query[0][candidates.keypoints[chosen]], frozen.points[candidates.points[chosen]]
        pose, K = _refine(xy, points, pose, K, size, refine_focal=refine_focal and len(chosen) >= 20)
    chosen, distance = _near(candidates, query, frozen, pose, K, radius=final_px)
    if len(chosen) < 6:
        return None
    pixels, front = _project(frozen.points[candidates.points], pose, K)
    agreeing = front & (np.linalg.norm(pixels - query[0][candidates.keypoints], axis=1) <= final_px)
    return PoseEstimate(
        pose,
        K,
        candidates.keypoints[chosen],
        candidates.points[chosen],
        support=float(np.sum(1 - (distance / final_px) ** 2)),
        ratio=_best_view_ratio(candidates, agreeing),
        residual=float(np.median(distance)),
    )


def estimate_pose(
    query: Keypoints,
    frozen: FrozenMap,
    candidates: Candidates,
    K: Float[np.ndarray, "3 3"],
    size: tuple[int, int],
    *,
    focal_factors: tuple[float, ...],
    refine_focal: bool,
    hypotheses: int = 4,
    max_error: float = 6.0,
    trials: int = 20000,
    seed: int = 0,
) -> PoseEstimate | None:
    """The grown hypothesis of one photograph that has most support; None when none has six agreeing points.

    Hypotheses come from RANSAC on the strong candidates, each time without those that earlier ones explained, at each
    focal length `focal_factors` · K. Deterministic for a given `seed`.
    """
    best: PoseEstimate | None = None
    strong = _distinct_pairs(candidates, query)
    for factor in focal_factors:
        at_focal = with_focal(K, K[0, 0] * factor)
        remaining = strong
        for _ in range(hypotheses):
            if len(remaining) < 6:
                break
            xy = query[0][candidates.keypoints[remaining]]
            points = frozen.points[candidates.points[remaining]]
            found = _ransac(xy, points, at_focal, size, max_error=max_error, trials=trials, seed=seed)
            if found is None:
                break
            pose, agreed = found
            remaining = remaining[~agreed]
            grown = grow_pose(candidates, query, frozen, pose, at_focal, size, refine_focal=refine_focal)
            if grown is not None and (best is None or grown.support > best.support):
                best = grown
    return best


def _distinct_pairs(candidates: Candidates, query: Keypoints) -> Int[np.ndarray, " i"]:
    """The strong candidates, each pair of a point and a place in the photograph once."""
    strong = np.flatnonzero(candidates.strong)
    place = np.round(query[0][candidates.keypoints[strong]] / _SAME_PLACE_PX)
    pairs = np.concatenate([candidates.points[strong][:, None], place], axis=1)
    _, first = np.unique(pairs, axis=0, return_index=True)
    return strong[np.sort(first)]
