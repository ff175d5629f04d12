"""Localisation of a whole capture: given poses stay, the others are placed against them, and chained by visit."""

import dataclasses
from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ltgs_jax.features import inside
from ltgs_jax.geometry import SE3, Camera
from ltgs_jax.io import CameraModel, Capture, InputError, Photograph, load_image, load_mask

from .affine import Keypoints, affine_keypoints
from .map import FrozenMap, View, extend_map
from .pose import PoseEstimate, estimate_pose, find_candidates, grow_pose, with_focal
from .retrieval import global_descriptor, most_alike
from .types import Localization, LocalizeConfig, PhotographStatus

Progress = Callable[[str, int, int], None]
"""Called with (what is done, how many are done, of how many)."""


@dataclasses.dataclass
class _Pending:
    """A photograph to be placed, and the best that was found so far."""

    photograph: Photograph
    size: tuple[int, int]
    K: Float[np.ndarray, "3 3"]
    lens_known: bool
    plain: Keypoints
    tilted: Keypoints | None
    look: Float[np.ndarray, " d"]
    estimate: PoseEstimate | None = None


def localize(
    capture: Capture,
    *,
    config: LocalizeConfig | None = None,
    progress: Progress | None = None,
) -> Localization:
    """Cameras of all photographs of a capture that can be placed (section 3.1 of the paper; gate of hloc's users).

    Photographs with a pose keep it and form the frozen map: their keypoints, matched along epipolar lines and
    triangulated. The others are placed by SIFT matches, RANSAC and growth along the prediction (`estimate_pose`); a
    later photograph that was placed joins the map, so that a visit's photographs help each other. `unused` photographs
    are left alone, `test` ones placed but never part of the map. Returns at once when every pose is given.

    Raises InputError when no photograph of the first visit has a pose.
    """
    config = config or LocalizeConfig()
    report = progress or (lambda what, done, total: None)
    known, unplaced = _split(capture, config)
    status = {p.name: _given_status(capture, i) for i, p in enumerate(capture.photographs) if p.camera is not None}
    cameras = {p.name: p.camera for p in capture.photographs if p.camera is not None}
    lenses: dict[str, CameraModel] = {}
    if unplaced:
        if not any(p.visit == 0 for p in known):
            raise InputError(f"{capture.folder}: no photograph of the first visit has a camera; run SfM on it first")
        for pending in _place_all(capture, known, unplaced, config, report):
            name = pending.photograph.name
            reason = _gate(pending.estimate, known, config)
            status[name] = _found_status(pending, reason)
            if reason is None:
                lenses[name] = found_lens(pending.photograph, pending.K, pending.size)
                cameras[name] = posed_camera(lenses[name], pending.estimate.cam_from_world)
            elif pending.photograph.camera is None:
                cameras.pop(name, None)
    statuses = tuple(status[p.name] for p in capture.photographs if p.name in status)
    return Localization(cameras, lenses, statuses)


def _split(capture: Capture, config: LocalizeConfig) -> tuple[list[Photograph], list[Photograph]]:
    """Photographs of the map, and those to be placed."""
    known, unplaced = [], []
    for p in capture.photographs:
        if p.camera is not None and not (config.refine_given and p.visit > 0):
            if p.role != "test":
                known.append(p)
        elif p.role != "unused" and (p.visit > 0 or config.first_visit):
            unplaced.append(p)
    return known, unplaced


def _place_all(
    capture: Capture, known: list[Photograph], unplaced: list[Photograph], config: LocalizeConfig, report: Progress
) -> list[_Pending]:
    """All photographs to be placed with the best pose found for each."""
    looks = np.stack([global_descriptor(load_image(p, max_side=160)) for p in known])
    waiting = []
    for i, p in enumerate(unplaced):
        report("keypoints of new photographs", i, len(unplaced))
        waiting.append(_pending(p, known, config))
    if len(known) > config.max_views:
        chosen = sorted({int(j) for q in waiting for j in most_alike(q.look, looks, config.retrieved)})
        known, looks = [known[j] for j in chosen], looks[chosen]
    views = []
    for i, p in enumerate(known):
        report("keypoints of the map", i, len(known))
        views.append(_known_view(p, config))
    report("triangulation", 0, 1)
    frozen = extend_map(None, tuple(views))
    later = [q for q in waiting if q.photograph.visit > 0]
    _place_chain(later, frozen, looks, known, config, report)
    for i, q in enumerate(q for q in waiting if q.photograph.visit == 0):
        report("first visit", i, len(waiting) - len(later))
        nearest = most_alike(q.look, looks, min(config.retrieved, 8)).tolist()
        q.estimate = _estimate(q, q.plain, frozen, nearest, config)
    return waiting


def _place_chain(
    later: list[_Pending],
    frozen: FrozenMap,
    looks: Float[np.ndarray, "c d"],
    known: list[Photograph],
    config: LocalizeConfig,
    report: Progress,
) -> None:
    """Place later photographs in rounds, plain SIFT before simulated views; each round's finds extend the map."""
    missing, accepted = list(later), []
    tilted, number = False, 0
    while missing:
        number += 1
        placed = []
        for i, q in enumerate(missing):
            report(f"placing, round {number}", i, len(missing))
            views = list(range(len(frozen.views)))
            if len(views) > config.max_views:
                views = most_alike(q.look, looks, config.retrieved).tolist()
            estimate = _estimate(q, _tilted_keypoints(q, config) if tilted else q.plain, frozen, views, config)
            if estimate is not None and (q.estimate is None or estimate.support > q.estimate.support):
                q.estimate = estimate
            if _gate(q.estimate, known, config) is None:
                placed.append(q)
        _share_focal(placed, later)
        accepted += placed
        missing = [q for q in missing if q not in placed]
        joining = [q for q in placed if q.photograph.role != "test"]
        if joining:
            frozen = extend_map(frozen, tuple(_placed_view(q) for q in joining))
            looks = np.concatenate([looks, *[q.look[None] for q in joining]])
        elif tilted or not config.tilts:
            break
        tilted = tilted or not joining or number >= 2
    _polish(accepted, frozen, config)


def _pixels(photograph: Photograph, config: LocalizeConfig) -> tuple[Float[np.ndarray, "h w 3"], Keypoints]:
    """The photograph at working size, and its plain keypoints outside the mask."""
    image = load_image(photograph, max_side=config.max_side)
    xy, descriptors = affine_keypoints(image, tilts=(), contrast=config.contrast)
    free = inside(xy, load_mask(photograph, max_side=config.max_side))
    return image, (xy[free], descriptors[free])


def _known_view(photograph: Photograph, config: LocalizeConfig) -> View:
    """A photograph of known pose with its keypoints."""
    image, (xy, descriptors) = _pixels(photograph, config)
    camera = photograph.camera.resized(image.shape[1], image.shape[0])
    pose = np.asarray(camera.cam_from_world.as_matrix(), np.float64)[:3]
    return View(photograph.name, photograph.visit, np.asarray(camera.K, np.float64), pose, xy, descriptors)


def _pending(photograph: Photograph, known: list[Photograph], config: LocalizeConfig) -> _Pending:
    """A photograph to be placed, with the best guess of its K."""
    image, plain = _pixels(photograph, config)
    height, width = image.shape[:2]
    K = working_K(photograph, known, (width, height))
    lens_known = photograph.camera_model is not None
    return _Pending(photograph, (width, height), K, lens_known, plain, None, global_descriptor(image))


def working_K(photograph: Photograph, known: list[Photograph], size: tuple[int, int]) -> Float[np.ndarray, "3 3"]:
    """K of a photograph without a pose at a working size: of its lens; of one that no file gives, the field of view of
    the known photograph of most similar shape, centred."""
    width, height = size
    if photograph.camera_model is not None:
        return photograph.camera_model.resized(width, height).K()
    alike = min(known, key=lambda p: abs(np.log(p.width * height / (p.height * width))))
    focal = float(alike.camera.K[0, 0]) * max(width, height) / max(alike.width, alike.height)
    return np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])


def _tilted_keypoints(pending: _Pending, config: LocalizeConfig) -> Keypoints:
    """Keypoints of the photograph and its simulated views, computed once."""
    if pending.tilted is None:
        image = load_image(pending.photograph, max_side=config.max_side)
        xy, descriptors = affine_keypoints(image, tilts=config.tilts, contrast=config.contrast)
        free = inside(xy, load_mask(pending.photograph, max_side=config.max_side))
        pending.tilted = xy[free], descriptors[free]
    return pending.tilted


def _estimate(
    pending: _Pending, query: Keypoints, frozen: FrozenMap, views: list[int], config: LocalizeConfig
) -> PoseEstimate | None:
    """The best pose against some views of the map."""
    candidates = find_candidates(query, frozen, views, max_ratio=config.max_ratio, min_cosine=config.min_cosine)
    return estimate_pose(
        query,
        frozen,
        candidates,
        pending.K,
        pending.size,
        focal_factors=(1.0,) if pending.lens_known else config.focal_factors,
        refine_focal=not pending.lens_known,
        seed=config.seed,
    )


def _share_focal(placed: list[_Pending], waiting: list[_Pending]) -> None:
    """Photographs of one size whose lens no file gives share one focal length: the median of those just placed."""
    for size in sorted({q.size for q in placed if not q.lens_known}):
        focals = [q.estimate.K[0, 0] for q in placed if q.size == size for _ in range(q.estimate.inliers)]
        for q in waiting:
            if q.size == size and not q.lens_known:
                q.K, q.lens_known = with_focal(q.K, float(np.median(focals))), True


def _placed_view(pending: _Pending) -> View:
    """A photograph that was placed, as a view of the map; with its plain keypoints, which do not repeat themselves."""
    estimate, photograph = pending.estimate, pending.photograph
    return View(photograph.name, photograph.visit, pending.K, estimate.cam_from_world, *pending.plain)


def _polish(placed: list[_Pending], frozen: FrozenMap, config: LocalizeConfig) -> None:
    """Refine every pose on the complete map, the photograph's own view left out."""
    for q in placed:
        query = q.plain if q.tilted is None else q.tilted
        others = [i for i, view in enumerate(frozen.views) if view.name != q.photograph.name]
        candidates = find_candidates(query, frozen, others, max_ratio=config.max_ratio, min_cosine=config.min_cosine)
        grown = grow_pose(candidates, query, frozen, q.estimate.cam_from_world, q.K, q.size, refine_focal=False)
        q.estimate = grown or q.estimate


def _gate(estimate: PoseEstimate | None, known: list[Photograph], config: LocalizeConfig) -> str | None:
    """Why a pose is not believed; None when it is."""
    if estimate is None:
        return "no pose agrees with six of its matches"
    if estimate.inliers < config.min_inliers:
        return f"only {estimate.inliers} of its keypoints agree with one pose, {config.min_inliers} are needed"
    if estimate.ratio < config.min_ratio:
        return f"only {estimate.ratio:.1%} of its matches agree with one pose, {config.min_ratio:.0%} are needed"
    return too_far(estimate.center(), known, config)


def too_far(center: Float[np.ndarray, "3"], known: list[Photograph], config: LocalizeConfig) -> str | None:
    """Why a place cannot be: it lies many extents of the known cameras away."""
    centers = np.stack([np.asarray(p.camera.center()) for p in known])
    extent = np.linalg.norm(np.ptp(centers, axis=0))
    distance = np.linalg.norm(center - centers.mean(axis=0))
    if extent > 0 and distance > config.max_extent * extent:
        return f"its place is {distance / extent:.0f} times the extent of the known cameras away"
    return None


def _given_status(capture: Capture, index: int) -> PhotographStatus:
    """A photograph whose pose the capture gives: the sparse points that it sees."""
    seen = int(np.sum(capture.point_observations.photographs == index))
    return PhotographStatus(capture.photographs[index].name, "given", seen or None, None, None)


def _found_status(pending: _Pending, reason: str | None) -> PhotographStatus:
    """What became of a photograph that was looked for."""
    estimate, photograph = pending.estimate, pending.photograph
    inliers = 0 if estimate is None else estimate.inliers
    residual = None if estimate is None else estimate.residual * photograph.width / pending.size[0]
    return PhotographStatus(photograph.name, "rejected" if reason else "localized", inliers, residual, reason)


def found_lens(photograph: Photograph, K: Float[np.ndarray, "3 3"], size: tuple[int, int]) -> CameraModel:
    """The lens of a photograph that was placed at a working size: the one that is known, else a pinhole of that K."""
    if photograph.camera_model is not None:
        return photograph.camera_model
    width, height = photograph.width, photograph.height
    fx, _, cx, _, _, cy, *_ = (K * np.array([[width / size[0]], [height / size[1]], [1.0]])).ravel()
    return CameraModel("SIMPLE_PINHOLE", width, height, (float(fx), float(cx), float(cy)))


def posed_camera(lens: CameraModel, cam_from_world: Float[np.ndarray, "3 4"]) -> Camera:
    """The pinhole camera of a lens at a pose, float32 as those that `io` reads."""
    pose = SE3.from_matrix(np.concatenate([cam_from_world, [[0.0, 0, 0, 1]]]).astype(np.float32))
    return lens.camera(SE3(jnp.asarray(pose.quat), jnp.asarray(pose.xyz)))
