"""Photometric alignment of a photograph with renders of the initial scene, for photographs that features cannot place.

Direct image alignment (Lucas & Kanade 1981; forward, on SE(3), coarse to fine, Geman-McClure weights) against the depth
and the image that a renderer gives at the current pose, which is rendered anew between the levels.
"""

import dataclasses
from collections.abc import Callable

import cv2
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ltgs_jax.geometry import SE3, Camera

RenderView = Callable[[Camera], tuple[np.ndarray, np.ndarray, np.ndarray]]
"""Camera -> image [h w 3] in [0, 1], depth [h w] camera z, alpha [h w]."""

_FINEST_PX = 320  # longer side of the finest level
_PATCH_PX = 16
_ROUGH_PX = 0.5  # at the finest level, up to which a pose is as good as alignment makes it
_BETTER = 0.9  # of what a pose leaves uncorrelated, below which another one is better
_AGREE = 0.67  # share of the textured patches that agree where a scene shows well enough to correct a pose by


@dataclasses.dataclass(frozen=True)
class Alignment:
    """A pose found by alignment: `agreeing` of `textured` patches of 16 px (at 320 px) correlate by more than one half;
    `correlation` over all pixels that both show."""

    cam_from_world: Float[np.ndarray, "3 4"]
    agreeing: int
    textured: int
    correlation: float


def _flattened(image: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w"]:
    """Grey less its surroundings, over their contrast: exposure, vignetting and shading fall out."""
    grey = cv2.cvtColor(np.clip(image, 0, 1).astype(np.float32), cv2.COLOR_RGB2GRAY)
    sigma = max(image.shape[:2]) / 12
    grey = cv2.GaussianBlur(grey, (0, 0), 1.0)
    centred = grey - cv2.GaussianBlur(grey, (0, 0), sigma)
    return centred / (np.sqrt(cv2.GaussianBlur(centred * centred, (0, 0), 2 * sigma)) + 0.02)


def _camera(pose: Float[np.ndarray, "3 4"], K: Float[np.ndarray, "3 3"], width: int, height: int) -> Camera:
    matrix = np.concatenate([pose, [[0.0, 0, 0, 1]]]).astype(np.float32)
    return Camera(SE3.from_matrix(jnp.asarray(matrix)), jnp.asarray(K, jnp.float32), width, height)


def _sampled(image: Float[np.ndarray, "h w"], pixels: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, " n"]:
    """Bilinear samples at pixel positions (corner at 0)."""
    at = (pixels - 0.5).astype(np.float32)
    # remap takes images with less than 32768 rows: the list is folded into one.
    side = int(np.ceil(np.sqrt(len(at)))) or 1
    folded = np.zeros((side * side, 2), np.float32)
    folded[: len(at)] = at
    grid = folded.reshape(side, side, 2)
    return cv2.remap(image, grid[..., 0], grid[..., 1], cv2.INTER_LINEAR).ravel()[: len(at)]


def _steps(photo, K, values, points, pose, *, iterations: int) -> Float[np.ndarray, "3 4"]:
    """Levenberg-Marquardt steps of the pose that lay `points` with their `values` onto the photograph."""
    height, width = photo.shape
    gradient = [cv2.Sobel(photo, cv2.CV_32F, dx, dy, ksize=3, scale=0.125) for dx, dy in ((1, 0), (0, 1))]
    focal, centre, damping = np.diag(K)[:2], K[:2, 2], 1e-3

    def residuals(candidate):
        local = points @ candidate[:, :3].T + candidate[:, 3]
        front = local[:, 2] > 1e-6
        pixels = local[:, :2] / np.where(front, local[:, 2], 1)[:, None] * focal + centre
        inner = front & np.all((pixels > 1) & (pixels < np.array([width, height]) - 1), axis=1)
        return local[inner], pixels[inner], _sampled(photo, pixels[inner]) - values[inner]

    def cost(residual, scale):
        # Pixels that leave the picture must not make it cheaper: they cost what an outlier does.
        return np.sum(residual**2 / (residual**2 + scale**2)) + (len(points) - len(residual))

    local, pixels, residual = residuals(pose)
    for _ in range(iterations):
        if len(residual) < 50:
            break
        scale = 1.5 * np.median(np.abs(residual)) + 1e-3
        weight = scale**2 / (residual**2 + scale**2) ** 2
        gx, gy = (_sampled(g, pixels) * f for g, f in zip(gradient, focal, strict=True))
        z = local[:, 2]
        by_point = np.stack([gx / z, gy / z, -(gx * local[:, 0] + gy * local[:, 1]) / z**2], axis=1)
        jacobian = np.concatenate([by_point, np.cross(local, by_point)], axis=1)
        normal = jacobian.T @ (weight[:, None] * jacobian)
        right = -jacobian.T @ (weight * residual)
        now = cost(residual, scale)
        step = np.linalg.solve(normal + damping * np.diag(np.diag(normal) + 1e-12), right)
        moved = _moved(pose, step)
        trial = residuals(moved)
        if cost(trial[2], scale) < now:
            pose, (local, pixels, residual), damping = moved, trial, max(damping / 5, 1e-6)
            if np.linalg.norm(step) < 1e-6:
                break
        else:
            damping *= 10
            if damping > 1e4:
                break
    return pose


def _moved(pose: Float[np.ndarray, "3 4"], step: Float[np.ndarray, "6"]) -> Float[np.ndarray, "3 4"]:
    """The pose after a small motion (translation, rotation) in the camera's frame."""
    rotation = cv2.Rodrigues(step[3:])[0]
    return rotation @ pose + np.concatenate([np.zeros((3, 3)), step[:3, None]], axis=1)


def _level(image, K, pose, render_view: RenderView, *, shrink: float, rounds: int) -> Float[np.ndarray, "3 4"]:
    """Render, align, render again, at one size."""
    photo, at_size = _resized(image, K, shrink)
    for _ in range(rounds):
        values, points = _rendered(image, K, pose, photo.shape, render_view)
        if len(points) < 50:
            return pose
        pose = _steps(photo, at_size, values, points, pose, iterations=20)
    return pose


def _resized(image, K, shrink: float) -> tuple[Float[np.ndarray, "h w"], Float[np.ndarray, "3 3"]]:
    height, width = image.shape[:2]
    size = (max(16, round(width * shrink)), max(16, round(height * shrink)))
    scaled = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    return _flattened(scaled), K * np.array([[size[0] / width], [size[1] / height], [1.0]])


def _view(image, K, pose, shape, render_view: RenderView):
    """Image, depth and alpha rendered at the size of the photograph, for which one program serves, and reduced."""
    rendered = render_view(_camera(pose, K, image.shape[1], image.shape[0]))
    ways = cv2.INTER_AREA, cv2.INTER_NEAREST, cv2.INTER_AREA  # depths on both sides of an edge have no mean
    return [cv2.resize(a, shape[::-1], interpolation=way) for a, way in zip(rendered, ways, strict=True)]


def _rendered(
    image, K, pose, shape, render_view: RenderView
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n 3"]]:
    """Flattened values and world points of the pixels of a reduced size that a render covers."""
    view, depth, alpha = _view(image, K, pose, shape, render_view)
    covered = (alpha > 0.5) & (depth > 0)
    rows, columns = np.nonzero(covered)
    pixels = (np.stack([columns, rows], axis=1) + 0.5) * (np.array(image.shape[1::-1]) / shape[::-1])
    local = np.concatenate([(pixels - K[:2, 2]) / np.diag(K)[:2], np.ones((len(pixels), 1))], axis=1)
    world = (local * depth[covered][:, None] - pose[:, 3]) @ pose[:, :3]
    return _flattened(view)[covered], world


def _score(image, K, pose, render_view: RenderView, *, shrink: float) -> Alignment:
    """How well a render at the pose looks like the photograph."""
    photo, _ = _resized(image, K, shrink)
    view, _, alpha = _view(image, K, pose, photo.shape, render_view)
    other, covered = _flattened(view), alpha > 0.5
    agreeing = textured = 0
    for top in range(0, photo.shape[0] - _PATCH_PX + 1, _PATCH_PX):
        for left in range(0, photo.shape[1] - _PATCH_PX + 1, _PATCH_PX):
            window = np.s_[top : top + _PATCH_PX, left : left + _PATCH_PX]
            a, b = photo[window].ravel(), other[window].ravel()
            if covered[window].mean() > 0.8 and min(a.std(), b.std()) > 0.15:
                textured += 1
                agreeing += bool(np.corrcoef(a, b)[0, 1] > 0.5)
    correlation = 0.0
    if covered.sum() > 50 and min(photo[covered].std(), other[covered].std()) > 0:
        correlation = float(np.corrcoef(photo[covered], other[covered])[0, 1])
    return Alignment(pose, agreeing, textured, correlation)


def correct_pose(
    image: Float[np.ndarray, "h w 3"],
    K: Float[np.ndarray, "3 3"],
    cam_from_world: Float[np.ndarray, "3 4"],
    render_view: RenderView,
) -> Alignment | None:
    """A better pose than the one that came with a photograph; None where the two show the same within half a pixel (at
    320 px), or a render at the new one does not look clearly more like the photograph, and like it all over.

    Args as of `align_photograph`. Not differentiable.
    """
    finest = min(1.0, _FINEST_PX / max(image.shape[:2]))
    pose = cam_from_world
    for shrink in (finest / 4, finest / 2, finest):
        photo, at_size = _resized(image, K, shrink)
        values, points = _rendered(image, K, pose, photo.shape, render_view)
        if len(points) < 50:
            return None
        pose = _steps(photo, at_size, values, points, pose, iterations=20)
        before, after = (_projected(at_size, each, points) for each in (cam_from_world, pose))
        shift = float(np.median(np.linalg.norm(after - before, axis=1))) * finest / shrink
        if shrink > finest / 4 and shift < _ROUGH_PX:
            return None
    found, given = (_score(image, K, each, render_view, shrink=finest) for each in (pose, cam_from_world))
    better = 1 - found.correlation < _BETTER * (1 - given.correlation)
    return found if better and found.agreeing > _AGREE * found.textured else None


def _projected(K, pose, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 2"]:
    local = points @ pose[:, :3].T + pose[:, 3]
    return local[:, :2] / np.maximum(local[:, 2:], 1e-6) * np.diag(K)[:2] + K[:2, 2]


def align_photograph(
    image: Float[np.ndarray, "h w 3"],
    K: Float[np.ndarray, "3 3"],
    starts: list[Float[np.ndarray, "3 4"]],
    render_view: RenderView,
) -> Alignment | None:
    """The pose at which a render looks most like the photograph, from several first guesses; None without any.

    Args: `image` in [0, 1] with its `K` px; `starts` cam_from_world; `render_view` gives image, depth and alpha.
    Guesses within about 10° and a tenth of the distance to the scene converge. All are aligned at a quarter of the
    finest size, the best two further. Not differentiable.
    """
    finest = min(1.0, _FINEST_PX / max(image.shape[:2]))
    coarse = []
    for pose in starts:
        for shrink in (finest / 8, finest / 4):
            pose = _level(image, K, pose, render_view, shrink=shrink, rounds=2)
        coarse.append(pose)
    scored = [_score(image, K, pose, render_view, shrink=finest / 2) for pose in coarse]
    scored.sort(key=lambda alignment: -alignment.correlation)
    best: Alignment | None = None
    for candidate in scored[:2]:
        pose = candidate.cam_from_world
        for shrink in (finest / 2, finest):
            pose = _level(image, K, pose, render_view, shrink=shrink, rounds=2)
        found = _score(image, K, pose, render_view, shrink=finest)
        if best is None or found.correlation > best.correlation:
            best = found
    return best
