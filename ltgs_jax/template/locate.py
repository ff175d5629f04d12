"""Where a known template stands now: show it at many poses, compare with all photographs of the visit at once.

First at hundreds of poses in small windows; then the best few descend, by Levenberg–Marquardt on the pixels.
"""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy import ndimage

from ltgs_jax.geometry import SE3, Camera, stack_cameras
from ltgs_jax.render import RenderPlan, plan_render, render
from ltgs_jax.scene import Splats

from .support import rotation_about


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


def _blocks(image: Float[np.ndarray, "h w *c"], step: int) -> Float[np.ndarray, "h2 w2 *c"]:
    """Means over blocks of `step` × `step` pixels; a remainder at the right and bottom is left out."""
    h, w = image.shape[0] // step, image.shape[1] // step
    return image[: h * step, : w * step].reshape(h, step, w, step, *image.shape[2:]).mean(axis=(1, 3))


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
        step = min(int(side / size), min(image.shape[:2]) // 8)
        if step > 1:  # what the window leaves out must not alias: means over whole blocks of pixels first
            image, left, top, side = _blocks(image, step), left / step, top / step, side / step
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


def half_crop(crop: Crop) -> Crop:
    """The same windows at half their size, by means over 2 × 2 pixels; those count that count whole."""

    def mean(leaf):
        v, s = leaf.shape[:2]
        return leaf.reshape(v, s // 2, 2, s // 2, 2, *leaf.shape[3:]).mean(axis=(2, 4))

    camera = crop.camera
    size = camera.width // 2
    K = camera.K * jnp.asarray([[0.5], [0.5], [1]], camera.K.dtype)
    return Crop(
        camera=Camera(camera.cam_from_world, K, size, size),
        target=mean(crop.target),
        backdrop=mean(crop.backdrop),
        depth=mean(crop.depth),
        valid=mean(crop.valid.astype(jnp.float32)) > 0.99,
        region=mean(crop.region.astype(jnp.float32)) > 0.5,
    )


def posed(cameras: Camera, world_from_template: SE3) -> Camera:
    """Cameras that see a template, left in its own frame, as `cameras` [v] see it at poses [m]: batched [m·v]."""
    m, v = world_from_template.xyz.shape[0], cameras.K.shape[0]
    spread = jax.tree.map(lambda leaf: jnp.repeat(leaf, v, axis=0), world_from_template)
    tile = jax.tree.map(lambda leaf: jnp.tile(leaf, (m,) + (1,) * (leaf.ndim - 1)), cameras)
    return Camera(tile.cam_from_world @ spread, tile.K, cameras.width, cameras.height)


_BATCH = 14  # poses rendered in one call: two with the six probes of a descent
_AT_ONCE = 9  # such calls in one, of a search on other devices than CPUs
_BEAM = ((32, 4), (16, 8), (8, 8), (6, 10), (6, 10), (6, 10))  # poses that a search follows, and steps around each
_AS_GOOD = 0.05  # unlikeness by which a pixel may be worse and still count as no worse
_WRONG = 0.5  # unlikeness from which on a pixel is clearly not explained
_CAP = 0.3  # colour error at which a pixel is simply wrong, however wrong
_DARK, _TIMID, _GAIN = 0.05, 1e-4, 0.7  # floor of ratios of colours; prior of a gain on nothing, and its most, in log
_SCALE = 0.15  # of a residual, beyond which it counts for little
_BLUR, _LOCAL = 1.5, 3.0  # pixels: of a descent's first steps; of the mean that greys lose
_NARROWER = 0.7  # what is left of the width of parabolas from round to round


@eqx.filter_jit
def unlikeness(
    images: Float[Array, "v h w 3"], target: Float[Array, "v h w 3"], valid: Bool[Array, "v h w"]
) -> Float[Array, "v h w"]:
    """How unlike the photographs `target` each pixel of the renders is, 0…1: half by colour, capped, half by structure,
    which survives other shading; 0 where a pixel does not count."""
    colour = jnp.minimum(jnp.mean(jnp.abs(images - target), axis=-1), _CAP) / _CAP
    structure = 1 - _structure(jnp.mean(images, axis=-1), jnp.mean(target, axis=-1))
    return (0.5 * colour + 0.5 * jnp.clip(structure, 0, 1)) * valid


@jax.jit
def _structure(a: Float[Array, "v s s"], b: Float[Array, "v s s"]) -> Float[Array, "v s s"]:
    """Covariance over variances of two grey images in binomial windows of 7 px: SSIM without its luminance term."""
    mean_a, mean_b = _window_mean(a), _window_mean(b)
    var_a, var_b = _window_mean(a * a) - mean_a**2, _window_mean(b * b) - mean_b**2
    covariance = _window_mean(a * b) - mean_a * mean_b
    floor = 0.03**2
    return (2 * covariance + floor) / (jnp.maximum(var_a, 0) + jnp.maximum(var_b, 0) + floor)


def _window_mean(image: Float[Array, "*b h w"]) -> Float[Array, "*b h w"]:
    """Binomial mean over 7 × 7 pixels, the border's repeated."""
    for axis in (image.ndim - 2, image.ndim - 1):
        padded = jnp.pad(image, [(3, 3) if i == axis else (0, 0) for i in range(image.ndim)], mode="edge")
        taps = [jax.lax.slice_in_dim(padded, i, i + image.shape[axis], axis=axis) for i in range(7)]
        image = (taps[0] + taps[6] + 6 * (taps[1] + taps[5]) + 15 * (taps[2] + taps[4]) + 20 * taps[3]) / 64
    return image


def likeness(images: Float[np.ndarray, "v s s 3"], cover: Float[np.ndarray, "v s s"], crop: Crop) -> float:
    """Mean structural agreement where the template shows, −1…1, in the middle of the views that show enough of it; −1
    where one alone does of several that changed: that is no evidence for a place."""
    agreement = np.asarray(_structure(np.mean(images, axis=-1), np.mean(crop.target, axis=-1)))
    shown = (cover > 0.5) & np.asarray(crop.valid)
    pixels = shown.sum(axis=(1, 2))
    enough = pixels > max(0.2 * pixels.max(), 8)
    if enough.sum() < min(2, max(1, np.asarray(crop.region).any(axis=(1, 2)).sum())):
        return -1.0
    means = np.sum(agreement * shown, axis=(1, 2))[enough] / pixels[enough]
    return float(np.median(means))


@eqx.filter_jit
def relit(
    images: Float[Array, "v s s 3"], cover: Float[Array, "v s s"], crop: Crop, strength: Float[Array, ""] | float = 1.0
) -> Float[Array, "v s s 3"]:
    """Composites with the template lit as the photographs show it: in each view a gain on what it covers,
    log-quadratic over the window, fitted to the photograph. A print that is wrong stays wrong; a shade that turned with
    the object does not, a ball's included, which no log-linear gain takes out. `strength` 0: left as they are."""
    target, grey = jnp.mean(crop.target, axis=-1), jnp.mean(images, axis=-1)
    rows, columns = np.mgrid[-1 : 1 : 1j * grey.shape[1], -1 : 1 : 1j * grey.shape[2]]
    basis = np.stack([np.ones_like(rows), columns, rows, columns**2, columns * rows, rows**2], axis=-1)
    basis = jnp.asarray(basis, images.dtype).reshape(-1, basis.shape[-1])
    shown = ((cover > 0.5) & crop.valid).reshape(len(images), -1)
    wanted = jnp.clip(jnp.log((target + _DARK) / (grey + _DARK)), -1, 1).reshape(shown.shape)
    near = shown[..., None] * basis
    prior = _TIMID * jnp.maximum(jnp.sum(shown, axis=1), 1)
    system = jnp.einsum("vpi,pj->vij", near, basis) + prior[:, None, None] * jnp.eye(basis.shape[-1])
    fitted = jnp.linalg.solve(system, jnp.einsum("vpi,vp->vi", near, wanted)[..., None])[..., 0]
    gain = jnp.exp(strength * jnp.clip(jnp.einsum("pi,vi->vp", basis, fitted), -_GAIN, _GAIN)).reshape(cover.shape)
    return images * (1 + cover * (gain - 1))[..., None]


def backdrop_error(crop: Crop) -> tuple[float, float]:
    """Mean over views of the unlikeness with nothing added to the backdrop; and the part of it that lies where the
    object is."""
    wrong = backdrop_unlikeness(crop)
    inside = np.where(np.asarray(crop.region), wrong, 0)
    return tuple(float(_mean_errors(pixels[None], crop)[0]) for pixels in (wrong, inside))


def backdrop_unlikeness(crop: Crop) -> Float[np.ndarray, "v s s"]:
    """How unlike the photographs each pixel is with nothing added to the backdrop."""
    return _unlike_crop(crop.backdrop, crop)


def _unlike_crop(images: Float[Array, "v s s 3"], crop: Crop) -> Float[np.ndarray, "v s s"]:
    return np.asarray(unlikeness(images, crop.target, crop.valid))


def explained(images: Float[np.ndarray, "v s s 3"], crop: Crop) -> tuple[float, float]:
    """Mean unlikeness with something added to the backdrop, and the share of the change that it explains; what is drawn
    beside the change counts against."""
    without, change = backdrop_error(crop)
    error = float(_mean_errors(_unlike_crop(images, crop)[None], crop)[0])
    return error, (without - error) / max(change, 1e-9)


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


@eqx.filter_jit
def _judged(template: Splats, poses: SE3, crop: Crop, tolerance, strength, plan: RenderPlan):
    """Mean unlikeness at each of m poses, lit as the photographs show it to this strength, how many of the pixels that
    changed the template covers there, overflow."""
    images, cover, overflow = _composites(template, poses, crop, tolerance, plan)
    images = jax.vmap(relit, (0, 0, None, None))(images, cover, crop, strength)
    wrong = jax.vmap(unlikeness, (0, None, None))(images, crop.target, crop.valid)
    return _mean_errors(wrong, crop), jnp.sum(cover * (crop.valid & crop.region), axis=(1, 2, 3)), overflow


def _mean_errors(wrong: Float[Array, "m v s s"], crop: Crop) -> Float[Array, " m"]:
    """Mean over views of the mean unlikeness of the pixels that count."""
    return jnp.mean(jnp.sum(wrong, axis=(2, 3)) / jnp.maximum(jnp.sum(crop.valid, axis=(1, 2)), 1), axis=1)


@eqx.filter_jit
def _linearised(template: Splats, poses: SE3, crop: Crop, tolerance, smooth: Float[Array, "s s"], plan: RenderPlan):
    """Of each of m poses, followed by its six probes: mean unlikeness, cost [m], and Gauss–Newton's matrix [m 6 6] and
    slope [m 6] per step of a probe; overflow. `smooth` blurs the residuals along each axis."""
    images, _, overflow = _composites(template, poses, crop, tolerance, plan)
    images = images.reshape(-1, 7, *images.shape[1:])
    wrong = jax.vmap(unlikeness, (0, None, None))(images[:, 0], crop.target, crop.valid)
    residual = (images - crop.target) * crop.valid[..., None]
    # Colours for where it stands; what is left of the greys without their local mean for the rest: that stays when the
    # object is shaded otherwise.
    grey = jnp.mean(residual, axis=-1, keepdims=True)
    detail = grey - _smoothed(grey, jnp.asarray(_smoothing(crop.camera.width, _LOCAL)))
    flat = _smoothed(jnp.concatenate([0.5 * residual, 2 * detail], axis=-1), smooth).reshape(len(images), 7, -1)
    here, steps = flat[:, 0], flat[:, 1:] - flat[:, :1]
    weighted = steps / (1 + (here / _SCALE) ** 2)[:, None] ** 2
    cost = jnp.sum(_SCALE**2 * here**2 / (_SCALE**2 + here**2), axis=1)
    curves = jnp.einsum("mip,mjp->mij", weighted, steps, precision="highest")
    falls = jnp.einsum("mip,mp->mi", weighted, here, precision="highest")
    return _mean_errors(wrong, crop), cost, curves, falls, overflow


def _smoothing(size: int, sigma: float) -> Float[np.ndarray, "s s"]:
    """The matrix that blurs a row of pixels by a Gaussian of `sigma` px, borders reflected."""
    return ndimage.gaussian_filter1d(np.eye(size, dtype=np.float32), sigma, axis=0, truncate=2)


def _smoothed(images: Float[Array, "*b s s c"], along: Float[Array, "s s"]) -> Float[Array, "*b s s c"]:
    """Images blurred along rows and columns."""
    return jnp.einsum("ij,...jkc,lk->...ilc", along, images, along, precision="highest")


def overlap_of(images: Float[np.ndarray, "v s s 3"], covered: Bool[np.ndarray, "v s s"], crop: Crop) -> float:
    """Share of a template's outlines that nothing speaks against: they lie on what changed, or look no less like the
    photographs than without it. Pooled over the views that have a region; `images` are composites with it."""
    region, valid = np.asarray(crop.region), np.asarray(crop.valid)
    fits = region | (_unlike_crop(images, crop) < backdrop_unlikeness(crop) + _AS_GOOD)
    used = covered & valid & region.any(axis=(1, 2), keepdims=True)
    return float(np.sum(used & fits) / max(np.sum(used), 1))


def recall_of(covered: Bool[np.ndarray, "v s s"], crop: Crop) -> float:
    """Share of the pixels of the region which nothing known explains that a template's outlines cover, or nearly, in
    the middle of the views that have such pixels."""
    wrong = np.asarray(crop.region & crop.valid) & (backdrop_unlikeness(crop) > _WRONG)
    near = ndimage.binary_dilation(covered, np.ones((1, 3, 3), bool), iterations=2)
    pixels = wrong.sum(axis=(1, 2))
    shares = (wrong & near).sum(axis=(1, 2))[pixels > 8] / pixels[pixels > 8]
    return float(np.median(shares)) if len(shares) else 0.0


def _middle(template: Splats) -> SE3:
    """The shift from the template's origin to the middle of what shows of it."""
    means = np.asarray(template.means)[np.asarray(template.opacities) > 0.1]
    return SE3(jnp.asarray([1.0, 0, 0, 0], jnp.float32), jnp.asarray(np.median(means, axis=0), jnp.float32))


def _slid(pose, center, shift, normal, angle):
    """A pose [4 4] turned by `angle` about `normal` through the posed `center` and then shifted."""
    pivot = pose[:3, :3] @ center + pose[:3, 3]
    turn = np.asarray(rotation_about(normal, angle))
    moved = np.eye(4)
    moved[:3, :3] = turn @ pose[:3, :3]
    moved[:3, 3] = turn @ (pose[:3, 3] - pivot) + pivot + shift
    return moved


def turned_round(pose: SE3, template: Splats, normal: Float[np.ndarray, "3"], count: int) -> SE3:
    """A pose [] of a template turned by each multiple of a `count`-th of a full turn about `normal`, itself first."""
    center, matrix = np.asarray(_middle(template).xyz, np.float64), np.asarray(pose.as_matrix(), np.float64)
    turns = [_slid(matrix, center, np.zeros(3), normal, 2 * np.pi * i / count) for i in range(count)]
    return SE3.from_matrix(jnp.asarray(np.stack(turns), jnp.float32))


class Refinement(eqx.Module):
    """Poses after descent and the mean unlikeness of each."""

    poses: SE3
    errors: Float[np.ndarray, " m"]


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
        return self._shown(_composites, template, poses, crop, tolerance)

    def score(
        self, template: Splats, poses: SE3, crop: Crop, *, tolerance: float, lit: bool = False
    ) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, " m"]]:
        """Mean unlikeness at each of m poses, rendered in batches (`lit` as the photographs show it), and how many of
        the pixels that changed it covers there."""
        few = poses.xyz.shape[0] <= _BATCH or jax.default_backend() == "cpu"
        step = _BATCH if few else _AT_ONCE * _BATCH
        poses, starts = jax.tree.map(np.asarray, poses), range(0, poses.xyz.shape[0], step)
        strength = jnp.asarray(lit, jnp.float32)
        parts = [self._shown(_judged, template, poses[i : i + step], crop, tolerance, strength) for i in starts]
        errors, covered = (np.concatenate(part) for part in zip(*parts, strict=True))
        return errors, covered

    def _shown(
        self, program, template: Splats, poses: SE3, crop: Crop, tolerance: float, *more
    ) -> tuple[np.ndarray, ...]:
        """What a program that renders all poses at once gives, with room for all their splats."""
        count, poses = poses.xyz.shape[0], jax.tree.map(np.asarray, poses)
        whole = _BATCH if count <= _BATCH else _AT_ONCE * _BATCH
        poses = poses[np.minimum(np.arange(whole), count - 1)]
        key = (template.count, poses.xyz.shape[0], *crop.depth.shape)
        plan = self._plans.get(key)
        if plan is None:
            plan = plan_render(template, posed(crop.camera, poses), slack=2.0)
        while True:
            *shown, overflow = program(template, poses, crop, jnp.asarray(tolerance, jnp.float32), *more, plan)
            if int(overflow) == 0:
                self._plans[key] = plan
                return tuple(np.asarray(leaf)[:count] for leaf in shown)
            needed = plan_render(template, posed(crop.camera, poses), slack=1.5)
            plan = RenderPlan(
                max(plan.intersections, needed.intersections) * 3 // 2, max(plan.rounds, needed.rounds) * 3 // 2
            )

    def slide(
        self,
        template: Splats,
        poses: SE3,
        crop: Crop,
        *,
        normal: Float[np.ndarray, "3"],
        size: float,
        tolerance: float,
        least: float,
        rng: np.random.Generator,
    ) -> tuple[SE3, Int[np.ndarray, " k"]]:
        """Each of m poses, best first, moved over the surface of unit `normal` and turned about it, to where it is
        least unlike the photographs: in every round of `_BEAM` the best of random steps around each, steps shrinking,
        and fewer poses followed; and which of the m each comes from. Where the template covers fewer than `least`
        pixels nothing can be said of a pose.

        Two in-plane shifts and a turn: the other three freedoms would let a wrong pose sink or tilt to please.
        """
        center = np.asarray(_middle(template).xyz, np.float64)
        axes = np.linalg.svd(normal[None])[2][1:]
        best = np.asarray(poses.as_matrix(), np.float64)
        origins = np.arange(len(best))
        for r, (kept, tries) in enumerate(_BEAM):
            best, origins = best[:kept], origins[:kept]
            steps = rng.normal(size=(len(best), tries, 3)) * np.array([0.25 * size, 0.25 * size, 0.35]) * 0.65**r
            steps[:, 0] = 0
            trial = np.stack(
                [
                    [_slid(pose, center, step[:2] @ axes, normal, step[2]) for step in around]
                    for pose, around in zip(best, steps, strict=True)
                ]
            )
            flat = SE3.from_matrix(jnp.asarray(trial.reshape(-1, 4, 4), jnp.float32))
            errors, covered = self.score(template, flat, crop, tolerance=tolerance)
            errors = np.where(covered < least, np.inf, errors).reshape(trial.shape[:2])
            order = np.argsort(errors.min(axis=1), kind="stable")
            best, origins = trial[order, errors.argmin(axis=1)[order]], origins[order]
        return SE3.from_matrix(jnp.asarray(best, jnp.float32)), origins

    def refine(
        self,
        template: Splats,
        poses: SE3,
        crop: Crop,
        *,
        size: float,
        tolerance: float,
        steps: int,
        blurred: int = 0,
    ) -> Refinement:
        """Descend from each of m poses, in all six freedoms. `size`: the template's diameter in scene units.

        Residuals are differences of colour and of grey detail with Geman–McClure weights (scale 0.15); the first
        `blurred` steps see them blurred, which widens the basin. A step that does not pay is taken back and damped
        more.
        """
        m, middle = poses.xyz.shape[0], _middle(template)
        delta = np.r_[np.full(3, 0.01 * size), np.full(3, 0.02)]
        probes = np.concatenate([np.zeros((1, 6)), np.diag(delta)])
        width = crop.camera.width
        smooth = _smoothing(width, _BLUR), np.eye(width, dtype=np.float32)
        damping = np.full(m, 1e-2)
        best = jax.tree.map(np.asarray, poses)
        best_cost, best_errors = np.full(m, np.inf), np.full(m, np.inf)
        normal, slope = np.zeros((m, 6, 6)), np.zeros((m, 6))
        trial = poses
        for step in range(steps):
            if step == blurred:
                best_cost[:] = np.inf
            spread = jax.tree.map(lambda leaf: jnp.repeat(jnp.asarray(leaf), len(probes), axis=0), trial)
            spread = jax.tree.map(np.asarray, _about(middle, spread, np.tile(probes, (m, 1))))
            looks = [
                self._shown(_linearised, template, spread[i : i + _BATCH], crop, tolerance, smooth[step >= blurred])
                for i in range(0, m * len(probes), _BATCH)
            ]
            errors, cost, curves, falls = (np.concatenate(part)[:m] for part in zip(*looks, strict=True))
            better = cost < best_cost
            normal = np.where(better[:, None, None], curves / delta[:, None] / delta, normal)
            slope = np.where(better[:, None], falls / delta, slope)
            damping = np.where(better, np.maximum(damping / 4, 1e-4), damping * 6)
            best = _where(better, jax.tree.map(np.asarray, trial), best)
            best_cost, best_errors = np.where(better, cost, best_cost), np.where(better, errors, best_errors)
            scale = np.einsum("mii->mi", normal)
            scale = scale + 1e-9 * scale.max(axis=1, keepdims=True) + 1e-12
            system = normal + (damping[:, None] * scale)[:, :, None] * np.eye(6)
            move = np.linalg.solve(system, -slope[..., None])[..., 0]
            # No step leaves the region in which a linearisation of pixels can mean anything.
            move[:, :3] = np.clip(move[:, :3], -0.15 * size, 0.15 * size)
            move[:, 3:] = np.clip(move[:, 3:], -0.3, 0.3)
            trial = _about(middle, jax.tree.map(jnp.asarray, best), move)
        return Refinement(jax.tree.map(jnp.asarray, best), best_errors)

    def polish(
        self,
        template: Splats,
        poses: SE3,
        crop: Crop,
        freedoms: Float[np.ndarray, "6 k"],
        *,
        tolerance: float,
        rounds: int,
    ) -> Refinement:
        """Each of m poses moved to where the unlikeness itself, lit as the photographs show it, is least: the residuals
        of a descent also pull towards where the shade of a template agrees. `freedoms`: what may change, tangents as
        wide as the first round looks.

        A round takes the unlikeness on both sides along each freedom and goes to the vertices of the parabolas; each
        round looks less wide.
        """
        middle, count = _middle(template), freedoms.shape[1]
        probes = np.concatenate([np.zeros((1, 6)), freedoms.T, -freedoms.T])
        m, each = poses.xyz.shape[0], np.arange(poses.xyz.shape[0])
        center = best = jax.tree.map(np.asarray, poses)
        best_errors = np.full(m, np.inf)
        for width in _NARROWER ** np.arange(rounds):
            around = jax.tree.map(lambda leaf: jnp.repeat(jnp.asarray(leaf), len(probes), axis=0), center)
            around = _about(middle, around, np.tile(width * probes, (m, 1)))
            errors = self.score(template, around, crop, tolerance=tolerance, lit=True)[0].reshape(m, -1)
            lost, least = errors[:, 0] > best_errors, errors.argmin(axis=1)
            better = errors[each, least] < best_errors
            best = _where(better, jax.tree.map(np.asarray, around[each * len(probes) + least]), best)
            best_errors = np.where(better, errors[each, least], best_errors)
            ahead, behind = errors[:, 1 : 1 + count], errors[:, 1 + count :]
            bend = np.maximum(ahead + behind - 2 * errors[:, :1], 1e-9)
            vertex = width * np.clip((behind - ahead) / 2 / bend, -1.5, 1.5) @ freedoms.T
            moved = _about(middle, jax.tree.map(jnp.asarray, center), vertex)
            center = _where(lost, best, jax.tree.map(np.asarray, moved))
        return Refinement(jax.tree.map(jnp.asarray, best), best_errors)


def _about(middle: SE3, poses: SE3, tangents: Float[np.ndarray, "m 6"]) -> SE3:
    """Poses moved in the template's frame about its middle: about a far origin, turns and shifts would be one and the
    same."""
    return poses @ middle @ SE3.exp(jnp.asarray(tangents, jnp.float32)) @ middle.inverse()


def freedoms_of(turning: Float[np.ndarray, "3"] | None) -> Float[np.ndarray, "6 k"]:
    """What may change of a pose, as columns of tangents: all, or the place and the turn about one axis."""
    return np.eye(6) if turning is None else np.c_[np.eye(6)[:, :3], np.r_[np.zeros(3), turning]]


def _where(chosen: Bool[np.ndarray, " m"], these: SE3, others: SE3) -> SE3:
    """Of two batches of poses, row by row the one or the other."""
    return jax.tree.map(lambda a, b: np.where(chosen.reshape(-1, *(1,) * (a.ndim - 1)), a, b), these, others)
