"""Later photographs held against renders of the initial scene: what features cannot place, and given poses that are
rough."""

import dataclasses
from functools import cache

import jax.numpy as jnp
import numpy as np

from ltgs_jax.io import Capture, InputError, Photograph, load_image

from .align import Alignment, RenderView, align_photograph, correct_pose
from .place import Progress, found_lens, posed_camera, too_far, working_K
from .retrieval import global_descriptor, most_alike
from .types import Localization, LocalizeConfig, PhotographStatus

_VOUCHED_PX = 2.0  # median distance of sparse points up to which they vouch for a pose
_STARTS = 4  # renders to align a photograph with: the poses of so many photographs that look like it


def align_later(
    capture: Capture,
    found: Localization,
    render_view: RenderView,
    *,
    max_side: int | None = None,
    config: LocalizeConfig | None = None,
    progress: Progress | None = None,
) -> Localization:
    """The localisation of a capture after its later photographs were held against renders of the initial scene.

    A photograph that features could not place is aligned from the poses of the photographs most like it
    (`align_photograph`). One that is to be used, and has a given pose for which no sparse points vouch, is aligned from
    there, and keeps it unless another is clearly better (`correct_pose`). Both are then `localized`, their inliers the
    patches that agree. Poses of `test` photographs are never touched, nor is what cannot be decoded.

    `capture` is as `localize` took it; `max_side` px of the photographs while they are aligned, at which `render_view`
    is asked for renders.
    """
    config = config or LocalizeConfig()
    report = progress or (lambda what, done, total: None)
    cameras, lenses = dict(found.cameras), dict(found.lenses)
    status = {s.name: s for s in found.photographs}
    known = [
        dataclasses.replace(p, camera=cameras[p.name])
        for p in capture.photographs
        if p.name in cameras and p.role != "test"
    ]
    later = [(i, p) for i, p in enumerate(capture.photographs) if p.visit > 0 and p.name in status]
    lost = [p for _, p in later if p.name not in cameras]
    given = [(i, p) for i, p in later if status[p.name].status == "given" and p.role == "update"]
    given = [p for i, p in given if not _vouched_for(capture, i, config)]
    looks = cache(lambda: np.stack([global_descriptor(load_image(p, max_side=160)) for p in known]))
    for i, p in enumerate(given + lost):
        report("holding against renders", i, len(given + lost))
        try:
            image = load_image(p, max_side=max_side)
        except InputError:
            continue  # who uses it names it
        size = image.shape[1], image.shape[0]
        K = working_K(p, known, size)
        if p.name in cameras:
            pose = np.asarray(cameras[p.name].cam_from_world.as_matrix(), np.float64)[:3]
            aligned = correct_pose(image, K, pose, render_view)
        else:
            aligned = _placed(image, K, known, looks(), render_view, config)
        if aligned is not None:
            lenses[p.name] = found_lens(p, K, size)
            cameras[p.name] = posed_camera(lenses[p.name], aligned.cam_from_world)
            status[p.name] = PhotographStatus(p.name, "localized", aligned.agreeing, None, None)
    return Localization(cameras, lenses, tuple(status[s.name] for s in found.photographs))


def _vouched_for(capture: Capture, index: int, config: LocalizeConfig) -> bool:
    """Whether the sparse points that a photograph sees, by the capture's own model, lie where its pose has them."""
    seen = capture.point_observations
    mine = seen.photographs == index
    if mine.sum() < config.min_inliers:
        return False
    points = jnp.asarray(capture.points[seen.points[mine]], jnp.float32)
    xy = capture.photographs[index].camera.project(points)[0]
    return float(np.median(np.linalg.norm(np.asarray(xy) - seen.pixels[mine], axis=1))) < _VOUCHED_PX


def _placed(
    image, K, known: list[Photograph], looks, render_view: RenderView, config: LocalizeConfig
) -> Alignment | None:
    """The pose of a photograph that features could not place; None where none is to be believed."""
    nearest = [known[i] for i in most_alike(global_descriptor(image), looks, _STARTS)]
    starts = [np.asarray(p.camera.cam_from_world.as_matrix(), np.float64)[:3] for p in nearest]
    found = align_photograph(image, K, starts, render_view)
    if found is None or found.agreeing < max(config.min_inliers, 0.5 * found.textured):
        return None
    center = -found.cam_from_world[:, :3].T @ found.cam_from_world[:, 3]
    return found if too_far(center, known, config) is None else None
