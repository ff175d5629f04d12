"""Where a known template stands now: show it at many poses, compare with all photographs of the visit at once.

First as bare points with a depth buffer, at hundreds of poses; then the best few as splats, by Levenberg–Marquardt.
"""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from scipy import ndimage

from ltgs_jax.geometry import C0, SE3, Camera, stack_cameras
from ltgs_jax.render import RenderPlan, plan_render, render
from ltgs_jax.scene import Splats


class Crop(eqx.Module):
    """Square windows of the visit's photographs around one unexplained object, scaled to one size.

    `camera` batched over v views; `target` the photographs in the scene's light, `backdrop` and `depth` the render of
    everything already known there; `valid` the pixels that count, `region` those of them that the object changed.
    """

    camera: Camera
    target: Float[Array, "v s s 3"]
    backdrop: Float[Array, "v s s 3"]
    depth: Float[Array, "v s s"]
    valid: Bool[Array, "v s s"]
    region: Bool[Array, "v s s"]


def crop_camera(camera: Camera, box: tuple[float, float, float], size: int) -> Camera:
    """The camera of the square window (left, top, side) in pixels, scaled to `size` × `size`."""
    left, top, side = box
    scale = size / side
    shift = jnp.asarray([[1, 0, -left], [0, 1, -top], [0, 0, 1]], camera.K.dtype)
    zoom = jnp.asarray([[scale], [scale], [1]], camera.K.dtype)
    return Camera(camera.cam_from_world, zoom * (shift @ camera.K), size, size)


def make_crop(
    cameras: Sequence[Camera],
    targets: Sequence[np.ndarray],
    backdrops: Sequence[np.ndarray],
    depths: Sequence[np.ndarray],
    valid: Sequence[np.ndarray],
    regions: Sequence[np.ndarray],
    boxes: Sequence[tuple[float, float, float]],
    *,
    size: int,
) -> Crop:
    """Cut the windows `boxes` (left, top, side in pixels, may reach beyond the image) out of every view."""

    def cut(image: np.ndarray, box) -> np.ndarray:
        left, top, side = box
        position = (np.arange(size) + 0.5) * side / size - 0.5
        rows, columns = top + position, left + position
        inside = ((rows > -0.5) & (rows < image.shape[0] - 0.5))[:, None] & (
            (columns > -0.5) & (columns < image.shape[1] - 0.5)
        )
        r = np.clip(rows, 0, image.shape[0] - 1.001)
        c = np.clip(columns, 0, image.shape[1] - 1.001)
        r0, c0 = r.astype(int), c.astype(int)
        fr, fc = (r - r0)[:, None], (c - c0)[None, :]
        if image.ndim == 3:
            fr, fc = fr[..., None], fc[..., None]
        r1, c1 = np.minimum(r0 + 1, image.shape[0] - 1), np.minimum(c0 + 1, image.shape[1] - 1)
        a, b = image[r0][:, c0], image[r0][:, c1]
        d, e = image[r1][:, c0], image[r1][:, c1]
        value = (a * (1 - fc) + b * fc) * (1 - fr) + (d * (1 - fc) + e * fc) * fr
        return value if image.ndim == 3 else np.where(inside, value, 0)

    return Crop(
        camera=stack_cameras([crop_camera(c, b, size) for c, b in zip(cameras, boxes, strict=True)]),
        target=jnp.asarray(np.stack([cut(i, b) for i, b in zip(targets, boxes, strict=True)]), jnp.float32),
        backdrop=jnp.asarray(np.stack([cut(i, b) for i, b in zip(backdrops, boxes, strict=True)]), jnp.float32),
        depth=jnp.asarray(np.stack([cut(i, b) for i, b in zip(depths, boxes, strict=True)]), jnp.float32),
        valid=jnp.asarray(np.stack([cut(v.astype(np.float32), b) > 0.5 for v, b in zip(valid, boxes, strict=True)])),
        region=jnp.asarray(np.stack([cut(r.astype(np.float32), b) > 0.5 for r, b in zip(regions, boxes, strict=True)])),
    )


def posed(cameras: Camera, world_from_template: SE3) -> Camera:
    """Cameras that see a template, left in its own frame, as `cameras` [v] see it at poses [m]: batched [m·v]."""
    m, v = world_from_template.xyz.shape[0], cameras.K.shape[0]
    spread = jax.tree.map(lambda leaf: jnp.repeat(leaf, v, axis=0), world_from_template)
    tile = jax.tree.map(lambda leaf: jnp.tile(leaf, (m,) + (1,) * (leaf.ndim - 1)), cameras)
    return Camera(tile.cam_from_world @ spread, tile.K, cameras.width, cameras.height)


_CAP = 0.4  # colour error at which a pixel is simply wrong, however wrong


def backdrop_error(crop: Crop) -> tuple[float, float]:
    """Mean over views of the colour error, capped at 0.4, with nothing added to the backdrop; and the part of it that
    lies where the object is."""
    empty = np.asarray(crop.backdrop)[None]
    inside = np.where(np.asarray(crop.region)[..., None], empty, np.asarray(crop.target))
    return float(np.mean(_view_errors(empty, crop))), float(np.mean(_view_errors(inside, crop)))


def _view_errors(images: Float[np.ndarray, "m v s s 3"], crop: Crop) -> Float[np.ndarray, "m v"]:
    """Mean capped colour error over the pixels that count."""
    difference = np.minimum(np.abs(images - np.asarray(crop.target)).mean(axis=-1), _CAP)
    valid = np.asarray(crop.valid)
    return np.sum(difference * valid, axis=(2, 3)) / np.maximum(valid.sum(axis=(1, 2)), 1)


def score_points(
    points: Float[np.ndarray, "n 3"],
    colors: Float[np.ndarray, "n 3"],
    poses: SE3,
    crop: Crop,
    *,
    tolerance: float,
) -> Float[np.ndarray, " m"]:
    """Colour error, averaged over views, with the points drawn 2 × 2 px at each of m poses, nearest in front.

    Coarse, but thousands of poses cost seconds and no compilation. `tolerance` in scene units: how far behind the known
    surface a point still shows.
    """
    matrices = np.asarray(poses.as_matrix(), np.float64)
    base = np.asarray(crop.camera.cam_from_world.as_matrix(), np.float64)
    K = np.asarray(crop.camera.K, np.float64)
    size = crop.depth.shape[-1]
    target, valid = np.asarray(crop.target), np.asarray(crop.valid)
    backdrop, depth = np.asarray(crop.backdrop), np.asarray(crop.depth)
    limit = np.where(depth > 0, depth + tolerance, np.inf)
    errors = np.zeros((len(matrices), len(base)))
    for v in range(len(base)):
        empty = np.minimum(np.abs(backdrop[v] - target[v]).mean(axis=-1), _CAP) * valid[v]
        projection = K[v] @ (base[v] @ matrices)[:, :3]
        local = points @ np.swapaxes(projection[:, :, :3], 1, 2) + projection[:, None, :, 3]
        z = local[..., 2]
        safe = np.where(z > 1e-6, z, 1)
        column, row = np.floor(local[..., 0] / safe - 0.5).astype(int), np.floor(local[..., 1] / safe - 0.5).astype(int)
        nearest = np.full((len(matrices), size * size), np.inf, np.float64)
        winner = np.full((len(matrices), size * size), -1)
        order = np.argsort(-z, axis=1, kind="stable")
        pose = np.arange(len(matrices))[:, None]
        for dy, dx in ((0, 0), (0, 1), (1, 0), (1, 1)):
            r, c = row + dy, column + dx
            good = (z > 1e-6) & (r >= 0) & (r < size) & (c >= 0) & (c < size)
            cell = np.where(good, r * size + c, 0)
            good &= z < limit[v].ravel()[cell]
            ordered = np.take_along_axis(np.where(good, cell, -1), order, axis=1)
            far_to_near = np.take_along_axis(z, order, axis=1)
            rows = np.broadcast_to(pose, ordered.shape)
            keep = ordered >= 0
            # Later assignments win, and the nearest points come last; the four offsets are merged by depth.
            layer = np.full_like(winner, -1)
            layer[rows[keep], ordered[keep]] = order[keep]
            depths = np.full_like(nearest, np.inf)
            depths[rows[keep], ordered[keep]] = far_to_near[keep]
            nearer = depths < nearest
            winner = np.where(nearer, layer, winner)
            nearest = np.where(nearer, depths, nearest)
        drawn = winner >= 0
        difference = np.minimum(np.abs(colors[winner] - target[v].reshape(-1, 3)).mean(axis=-1), _CAP)
        difference = np.where(drawn, difference * valid[v].ravel(), empty.ravel())
        errors[:, v] = difference.sum(axis=1) / max(valid[v].sum(), 1)
    return errors.mean(axis=1)


def point_colors(splats: Splats) -> Float[np.ndarray, "n 3"]:
    """Mean colour of each splat over directions."""
    return np.clip(np.asarray(splats.sh[:, 0]) * C0 + 0.5, 0, 1)


@eqx.filter_jit
def _composites(template: Splats, poses: SE3, crop: Crop, tolerance, plan: RenderPlan):
    """The template in front of the backdrop where it is nearer than what is known there, [m v s s 3]; its visible
    alpha; overflow."""
    out = render(template, posed(crop.camera, poses), plan=plan)
    shape = (poses.xyz.shape[0], *crop.depth.shape)
    alpha, depth = out.alpha.reshape(shape), out.depth.reshape(shape)
    front = (depth < crop.depth + tolerance) | (crop.depth <= 0)
    image = jnp.where(front[..., None], out.image.reshape(*shape, 3), 0)
    cover = jnp.where(front, alpha, 0)
    return image + (1 - cover)[..., None] * crop.backdrop, cover, out.overflow


def _overlap(covered: Bool[np.ndarray, "m v s s"], crop: Crop) -> Float[np.ndarray, " m"]:
    """Share of the outlines that lies on what changed, pooled over the views that have a region."""
    region, valid = np.asarray(crop.region), np.asarray(crop.valid)
    used = valid & region.any(axis=(1, 2), keepdims=True)
    return np.sum(covered & region & used, axis=(1, 2, 3)) / np.maximum(np.sum(covered & used, axis=(1, 2, 3)), 1)


class Refinement(eqx.Module):
    """Poses after descent, the mean capped colour error of each, and the share of its outlines that
    lies on what changed."""

    poses: SE3
    errors: Float[np.ndarray, " m"]
    overlaps: Float[np.ndarray, " m"]


class Refiner:
    """Levenberg–Marquardt on the pixels of all views, several starts at once, derivatives by differences.

    Forward renders alone, one compilation per template bucket and window size, kept over calls.
    """

    def __init__(self) -> None:
        self._plans: dict[tuple[int, ...], RenderPlan] = {}

    def images(
        self, template: Splats, poses: SE3, crop: Crop, tolerance: float
    ) -> tuple[Float[np.ndarray, "m v s s 3"], Float[np.ndarray, "m v s s"]]:
        """Composites at every pose, and the template's visible alpha."""
        key = (template.count, poses.xyz.shape[0], *crop.depth.shape)
        plan = self._plans.get(key)
        if plan is None:
            plan = plan_render(template, posed(crop.camera, poses), slack=2.0)
        while True:
            images, cover, overflow = _composites(template, poses, crop, jnp.asarray(tolerance, jnp.float32), plan)
            if int(overflow) == 0:
                self._plans[key] = plan
                return np.asarray(images), np.asarray(cover)
            needed = plan_render(template, posed(crop.camera, poses), slack=1.5)
            plan = RenderPlan(
                max(plan.intersections, needed.intersections) * 3 // 2, max(plan.rounds, needed.rounds) * 3 // 2
            )

    def refine(
        self, template: Splats, poses: SE3, crop: Crop, *, size: float, tolerance: float, steps: int = 12
    ) -> Refinement:
        """Descend from each of m poses. `size`: the template's diameter in scene units.

        Residuals are colour differences with Geman–McClure weights (scale 0.15); the first third of the steps sees
        them blurred, which widens the basin. A step that does not pay is taken back and damped more.
        """
        m = poses.xyz.shape[0]
        delta = np.r_[np.full(3, 0.01 * size), np.full(3, 0.02)]
        probes = np.concatenate([np.zeros((1, 6)), np.diag(delta)])
        damping = np.full(m, 1e-2)
        best = jax.tree.map(np.asarray, poses)
        best_cost, best_errors, best_overlaps = np.full(m, np.inf), np.full(m, np.inf), np.zeros(m)
        normal = np.zeros((m, 6, 6))
        slope = np.zeros((m, 6))
        trial = poses
        valid = np.asarray(crop.valid)[None, None, ..., None]
        target = np.asarray(crop.target)
        for step in range(steps):
            if step == steps // 3:
                best_cost[:] = np.inf
            blur = 1.5 if step < steps // 3 else 0.0
            spread = jax.tree.map(lambda leaf: jnp.repeat(jnp.asarray(leaf), 7, axis=0), trial)
            spread = spread @ SE3.exp(jnp.asarray(np.tile(probes, (m, 1)), jnp.float32))
            images, cover = self.images(template, spread, crop, tolerance)
            images = images.reshape(m, 7, *images.shape[1:])
            errors = _view_errors(images[:, 0], crop).mean(axis=1)
            overlaps = _overlap(cover.reshape(m, 7, *cover.shape[1:])[:, 0] > 0.5, crop)
            residual = (images - target) * valid
            if blur:
                residual = ndimage.gaussian_filter(residual, (0, 0, 0, blur, blur, 0), truncate=2)
            flat = residual.reshape(m, 7, -1)
            weight = 1 / (1 + (flat[:, 0] / 0.15) ** 2) ** 2
            cost = np.sum(0.15**2 * flat[:, 0] ** 2 / (0.15**2 + flat[:, 0] ** 2), axis=1)
            better = cost < best_cost
            jacobian = (flat[:, 1:] - flat[:, :1]) / delta[:, None]
            weighted = jacobian * weight[:, None]
            new_normal = weighted @ np.swapaxes(jacobian, 1, 2)
            new_slope = np.einsum("mjp,mp->mj", weighted, flat[:, 0])
            normal = np.where(better[:, None, None], new_normal, normal)
            slope = np.where(better[:, None], new_slope, slope)
            damping = np.where(better, np.maximum(damping / 4, 1e-4), damping * 6)
            best = jax.tree.map(
                lambda new, old, b=better: np.where(b.reshape(-1, *(1,) * (old.ndim - 1)), np.asarray(new), old),
                trial,
                best,
            )
            best_cost, best_errors = np.where(better, cost, best_cost), np.where(better, errors, best_errors)
            best_overlaps = np.where(better, overlaps, best_overlaps)
            scale = np.einsum("mii->mi", normal)
            scale = scale + 1e-9 * scale.max(axis=1, keepdims=True) + 1e-12
            system = normal + (damping[:, None] * scale)[:, :, None] * np.eye(6)
            move = -np.linalg.solve(system, slope[..., None])[..., 0]
            # No step leaves the region in which a linearisation of pixels can mean anything.
            move[:, :3] = np.clip(move[:, :3], -0.15 * size, 0.15 * size)
            move[:, 3:] = np.clip(move[:, 3:], -0.3, 0.3)
            trial = jax.tree.map(jnp.asarray, best) @ SE3.exp(jnp.asarray(move, jnp.float32))
        return Refinement(jax.tree.map(jnp.asarray, best), best_errors, best_overlaps)
