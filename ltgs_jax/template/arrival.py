"""Something came: a known template at a new pose, or a new object built from its outlines and photographs."""

import dataclasses
from collections.abc import Mapping, Sequence
from types import MappingProxyType

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage

from ltgs_jax.geometry import C0, SE3, quat_from_rotmat
from ltgs_jax.match import Cone, Instance, carve, grid_around
from ltgs_jax.scene import Splats, Template, pad_splats

from .config import TemplateConfig
from .consistency import surface_evidence
from .locate import (
    Crop,
    Refiner,
    backdrop_error,
    explained,
    freedoms_of,
    half_crop,
    likeness,
    overlap_of,
    recall_of,
    relit,
    turned_round,
)
from .support import Support, Vantage, fit_support, rotation_about

_TURNS = 24  # in place, of what was found: a print is told from no further than some ten degrees
_EVERY = 12  # turns that must explain a change as well for the turn to be unknown
_ASIDE = 0.1  # of an object's size: half as far as a turn is tried to the sides of its place
_WIDTH = np.r_[np.full(3, 0.02), np.full(3, 0.04)]  # in sizes and radians: where a pose is polished at first
_ROUNDS = 6  # of polish
_FINER = 0.35  # of that width, for what was polished for half of them
_IN_SIGHT = 0.3  # of the pixels that the middle pose covers, from which on a pose is in sight
_PARALLEL = np.radians(8)  # between the normals of two surfaces, up to which they are taken for parallel
_LEVEL_APART = 0.3  # in heights of the object: surfaces nearer to each other than this are taken for one
_LEANS = np.radians(20)  # from the normal, beyond which something lies on another side
_LEVEL_MARGIN = 0.03  # by which it may look worse upright and still be taken to stand so
_ALIKE = 0.5  # share of what a pose explains that every other turn must explain for the turn to be unknown
SEARCH = "search"  # the evidence for a pose: renders at many poses, compared with the photographs
_AGREE = 0.06  # difference of colours at which two photographs hardly show one surface


class Placement(eqx.Module):
    """A template found again: its pose, the mean unlikeness with it, the share of the change it explains, the share of
    its outlines that nothing speaks against, its structural likeness to the photographs, the share of what changed
    clearly that its outlines cover, its outlines in the windows, the axis in the template's frame about which any turn
    explains the change as well (None: one does better than others), and the evidence that proposed the pose."""

    world_from_template: SE3
    error: float
    gain: float
    overlap: float
    likeness: float
    recall: float
    outlines: Bool[np.ndarray, "v s s"]
    ambiguous_axis: Float[np.ndarray, "3"] | None = None
    evidence: str = eqx.field(static=True, default=SEARCH)

    @property
    def worth(self) -> float:
        """Evidence for the template: it explains the change, looks like the photographs, and leaves none of it out."""
        return self.gain * self.likeness * self.recall if min(self.gain, self.likeness) > 0 else 0.0


def middle_of(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "3"]:
    """The middle of the box that holds the central 90 % of points along each axis: where the seen side of an object has
    more of them than the other, their median is not on its axis."""
    return np.quantile(points, [0.05, 0.95], axis=0).mean(axis=0)


def rotation_between(a: Float[np.ndarray, "3"], b: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """The smallest rotation that takes unit vector a to b."""
    axis, cosine = np.cross(a, b), float(a @ b)
    if cosine < -0.999999:
        other = np.eye(3)[np.argmin(np.abs(a))]
        axis = np.cross(a, other)
        axis /= np.linalg.norm(axis)
        return 2 * np.outer(axis, axis) - np.eye(3)
    skew = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.eye(3) + skew + skew @ skew / (1 + cosine)


def pose_hypotheses(
    template: Float[np.ndarray, "n 3"],
    stood_on: Support,
    stands_on: Support,
    places: Float[np.ndarray, "p 3"],
    *,
    turns: int,
    spread: float,
    tilts: Sequence[Float[np.ndarray, "3 3"]] = (np.eye(3),),
) -> SE3:
    """Poses of a template (points in its frame, on `stood_on`) on another support around `places` (scene units).

    For each tilt and each of `turns` turns about the normal: each place itself and a ring around it, 0.35 `spread`
    wide; around one that is alone, another of 0.8. Upright, it keeps its height above what it stood on, of which the
    lowest points may say little: no photograph shows them; tilted, the lowest points touch the support.
    """
    center = middle_of(template)
    stood = stood_on.height(center[None])[0]
    align = rotation_between(stood_on.normal, stands_on.normal)
    widths = (0.35, 0.8) if len(places) == 1 else (0.35,)
    around = np.concatenate([np.zeros((1, 3)), *[width * spread * stands_on.ring() for width in widths]])
    matrices = []
    for tilt in tilts:
        for turn in range(turns):
            rotation = rotation_about(stands_on.normal, 2 * np.pi * turn / turns) @ align @ tilt
            upright = np.allclose(tilt, np.eye(3))
            lift = stood if upright else -np.quantile((template - center) @ rotation.T @ stands_on.normal, 0.02)
            for place in places:
                rest = place + (lift - stands_on.height(place[None])[0]) * stands_on.normal
                matrix = np.tile(np.eye(4), (len(around), 1, 1))
                matrix[:, :3, :3] = rotation
                matrix[:, :3, 3] = rest + around - rotation @ center
                matrices.append(matrix)
    return SE3.from_matrix(jnp.asarray(np.concatenate(matrices), jnp.float32))


def tilts_of(support: Support) -> list[Float[np.ndarray, "3 3"]]:
    """The rotations that lay an object on each of its other five sides."""
    u, v, _ = support.frame()
    return [
        rotation_about(u, np.pi / 2),
        rotation_about(u, -np.pi / 2),
        rotation_about(v, np.pi / 2),
        rotation_about(v, -np.pi / 2),
        rotation_about(u, np.pi),
    ]


def thin(splats: Splats, most: int) -> Splats:
    """Exactly `most` splats: those of largest opacity × area, made to cover as much as all did, or padded with
    invisible ones, so that every template runs in one compiled program."""
    if splats.count <= most:
        return jax.device_put(pad_splats(splats, most))
    area = np.exp(np.sum(np.sort(np.asarray(splats.log_scales), axis=1)[:, 1:], axis=1)) * np.asarray(splats.opacities)
    keep = np.sort(np.argsort(-area, kind="stable")[:most])
    grow = 0.5 * np.log(area.sum() / area[keep].sum())
    return eqx.tree_at(lambda s: s.log_scales, splats[keep], splats.log_scales[keep] + min(grow, 0.7))


class Search(eqx.Module):
    """Promising poses of a template, from one surface to another, and the mean unlikeness with it at each; the error
    `without` it, the part of that which is to be explained, and the evidence that proposed each pose."""

    template: Splats
    stood_on: Support
    stands_on: Support
    poses: SE3
    errors: Float[np.ndarray, " m"]
    without: float
    change: float
    evidence: tuple[str, ...] = eqx.field(static=True, default=(SEARCH,))

    @property
    def best_gain(self) -> float:
        """Share of the change that the best of the poses explains; what is drawn beside it counts against."""
        return (self.without - float(self.errors.min())) / max(self.change, 1e-9)


def search_template(
    template: Template,
    stood_on: Support,
    stands_on: Support,
    places: Float[np.ndarray, "p 3"],
    crop: Crop,
    *,
    size: float,
    refiner: Refiner,
    rng: np.random.Generator,
    before: SE3 | None = None,
    upright: bool = True,
    matched: Mapping[str, SE3] = MappingProxyType({}),
    config: TemplateConfig = TemplateConfig(),
) -> Search:
    """Poses at which a template, rendered at many turns and places on the support, looks like the photographs.

    Upright, and at its pose `before`; or, if not `upright`, on its other sides. The best two, best first, of these and
    of the poses that other evidence proposes (`matched`, by its name), which the search follows as it does its own.

    Coarse windows tell the right one of a template's poses, and not one template from another: at half the size even a
    box where it stands may explain nothing, and what is full of detail explains nothing a few degrees beside its pose.
    What the best two explain is measured in the windows themselves, after some steps of descent.
    """
    light, lighter = (thin(template.splats, count) for count in (config.search_splats, config.search_splats // 2))
    points = shown_points(light)
    coarse = half_crop(crop)
    without, change = backdrop_error(crop)
    options = {"tolerance": 0.1 * size}
    tilts, turns = ([np.eye(3)], config.yaw_steps) if upright else (tilts_of(stood_on), config.yaw_steps // 2)
    hypotheses = pose_hypotheses(points, stood_on, stands_on, places, turns=turns, spread=size, tilts=tilts)
    if before is not None:
        hypotheses = jax.tree.map(lambda a, b: jnp.concatenate([a, jnp.asarray(b)[None]]), hypotheses, before)
    scores, covered = refiner.score(lighter, hypotheses, coarse, **options)
    # Behind what is known no pose is wrong, and none is right.
    least = _IN_SIGHT * np.median(covered)
    scores = np.where(covered < least, np.inf, scores)
    chosen = _unlike(hypotheses, scores, config.starts, distance=0.3 * size, angle=0.4)
    given = [levelled(pose, points, stood_on, stands_on) or pose for pose in matched.values()]
    starts = hypotheses[chosen[: config.starts - len(given)]]
    starts = jax.tree.map(lambda leaf, *more: jnp.concatenate([*(m[None] for m in more), leaf]), starts, *given)
    names = (*matched, *[SEARCH] * config.starts)
    poses, origins = refiner.slide(
        lighter, starts, coarse, normal=stands_on.normal, size=size, least=least, rng=rng, **options
    )
    errors, _ = refiner.score(light, poses, crop, **options)
    two = np.argsort(errors, kind="stable")[:2]
    near = refiner.refine(light, poses[two], crop, size=size, steps=6, blurred=3, **options)
    order = np.argsort(near.errors, kind="stable")
    evidence = tuple(names[i] for i in origins[two[order]])
    return Search(light, stood_on, stands_on, near.poses[order], near.errors[order], without, change, evidence)


def settle_template(search: Search, crop: Crop, *, size: float, refiner: Refiner) -> Placement:
    """Refine the poses of a search on the pixels, in all six freedoms, and the best turns in place of what comes of
    it: cartons, mugs and bottles look alike from several sides, which coarse windows do not tell. Of these the one
    with the most evidence when lit as the photographs show it: shade weighs as much as detail in the error, and it
    stays where it is when an object turns. It stands upright, as it stood, unless the pixels clearly say that it leans.
    """
    found = refiner.refine(search.template, search.poses, crop, size=size, tolerance=0.1 * size, steps=12, blurred=3)
    best = int(np.argmin(found.errors))
    first, evidence = found.poses[best], search.evidence[best]
    points, supports = shown_points(search.template), (search.stood_on, search.stands_on)
    # The descent follows shade, and leans what is round: its turns are those of it upright.
    stood = (levelled(pose, points, *supports) for pose in (first, search.poses[best]))
    stood = next((pose for pose in stood if pose is not None), first)
    turned = _other_turns(search, stood, crop, size=size, refiner=refiner)
    poses = [nudged(search, pose, crop, size=size, refiner=refiner) for pose in (first, *turned)]
    lit = [place_template(search, pose, crop, size=size, refiner=refiner, lit=True) for pose in poses]
    likeliest = max(range(len(poses)), key=lambda i: (lit[i].worth, -lit[i].error))
    chosen, evidence = poses[likeliest], evidence if likeliest == 0 else SEARCH
    chosen, least = _polished(search, chosen, None, crop, size, refiner, _ROUNDS // 2, width=_FINER)
    upright = levelled(chosen, points, *supports)
    if upright is not None:
        upright, error = _polished(search, upright, search.stood_on.normal, crop, size, refiner, _ROUNDS)
        if error <= least * (1 + _LEVEL_MARGIN):
            chosen = upright
    placed = place_template(search, chosen, crop, size=size, refiner=refiner)
    axis = search.stood_on.normal if _looks_alike(search, chosen, crop, size, refiner) else None
    return dataclasses.replace(placed, ambiguous_axis=axis, evidence=evidence)


def _looks_alike(search: Search, pose: SE3, crop: Crop, size: float, refiner: Refiner) -> bool:
    """Whether a template explains the windows about as well at every other turn about the normal of what it stood on,
    lit as they show it: a plain cylinder does."""
    axis = np.asarray(pose.as_matrix(), np.float64)[:3, :3] @ search.stood_on.normal
    turned = turned_round(pose, search.template, axis, _EVERY)
    images, cover = refiner.images(search.template, turned, crop, 0.1 * size)
    gains = [explained(relit(image, shown, crop), crop)[1] for image, shown in zip(images, cover, strict=True)]
    return min(gains) > _ALIKE * max(gains[0], 0)


def _polished(
    search: Search, pose: SE3, turning, crop: Crop, size: float, refiner: Refiner, rounds: int, *, width: float = 1.0
) -> tuple[SE3, float]:
    """A pose [] where the unlikeness, lit as the photographs show it, is least nearby, and that."""
    freedoms = freedoms_of(turning) * (width * _WIDTH * np.r_[np.full(3, size), np.ones(3)])[:, None]
    found = refiner.polish(search.template, pose[None], crop, freedoms, tolerance=0.1 * size, rounds=rounds)
    return found.poses[0], float(found.errors[0])


def nudged(search: Search, pose: SE3, crop: Crop, *, size: float, refiner: Refiner) -> SE3:
    """A pose [] of a search's template moved to where it looks most like the windows nearby, lit as they show it."""
    return _polished(search, pose, None, crop, size, refiner, _ROUNDS // 2)[0]


def _other_turns(search: Search, pose: SE3, crop: Crop, *, size: float, refiner: Refiner) -> list[SE3]:
    """The best other turns of a pose [] about the surface's normal, two at most, of those that are better than the ones
    next to them, each where it fits best: what is to one side of an object's axis, as a handle, is to the other when it
    has turned.
    """
    tolerance = 0.1 * size
    turns = turned_round(pose, search.template, search.stands_on.normal, _TURNS)
    shifts = 2 * _ASIDE * size * np.concatenate([np.zeros((1, 3)), search.stands_on.ring()])
    places = (np.asarray(turns.xyz)[:, None] + shifts).reshape(-1, 3)
    every = SE3(jnp.repeat(turns.quat, len(shifts), axis=0), jnp.asarray(places, jnp.float32))
    errors = refiner.score(search.template, every, crop, tolerance=tolerance, lit=True)[0].reshape(_TURNS, -1)
    nearest = every[np.arange(_TURNS) * len(shifts) + errors.argmin(axis=1)]
    along = np.zeros((6, 2))
    along[:3] = _ASIDE * size * search.stood_on.frame()[:2].T
    fitted = refiner.polish(search.template, nearest, crop, along, tolerance=tolerance, rounds=3)
    least = fitted.errors
    dips = np.flatnonzero((least <= np.roll(least, 1)) & (least <= np.roll(least, -1)))
    others = dips[dips > 0]
    return [fitted.poses[i] for i in others[np.argsort(least[others], kind="stable")[:2]]]


def shown_points(splats: Splats) -> Float[np.ndarray, "n 3"]:
    """Centres of the splats that show: a thinned template ends in ones that do not."""
    return np.asarray(splats.means, np.float64)[np.asarray(splats.opacities) > 0.1]


def levelled(pose: SE3, points: Float[np.ndarray, "n 3"], stood: Support, stands: Support) -> SE3 | None:
    """A pose of a template's points with what it leans turned back, as high above the surface as it stood; None where
    it leans far, on another side.

    Two surfaces that agree at its new place but for a little are one: the difference is that of their estimates.
    """
    matrix = np.asarray(pose.as_matrix(), np.float64)
    before = middle_of(points)
    middle = matrix[:3, :3] @ before + matrix[:3, 3]
    height = stood.height(before[None])[0]
    apart = abs(stood.height(middle[None])[0] - stands.height(middle[None])[0])
    if stood.normal @ stands.normal > np.cos(_PARALLEL) and apart < _LEVEL_APART * abs(height):
        stands = stood
    leaning = matrix[:3, :3] @ stood.normal
    if leaning @ stands.normal < np.cos(_LEANS):
        return None
    back = rotation_between(leaning, stands.normal)
    rise = (height - stands.height(middle[None])[0]) * stands.normal
    matrix[:3, 3] = back @ (matrix[:3, 3] - middle) + middle + rise
    matrix[:3, :3] = back @ matrix[:3, :3]
    return SE3.from_matrix(jnp.asarray(matrix, jnp.float32))


def place_template(
    search: Search, pose: SE3, crop: Crop, *, size: float, refiner: Refiner, lit: bool = False
) -> Placement:
    """A search's template at this very pose, and how well it explains the windows there; `lit` as they show it."""
    images, cover = refiner.images(search.template, pose[None], crop, 0.1 * size)
    shown = relit(images[0], cover[0], crop) if lit else images[0]
    error, gain = explained(shown, crop)
    covered = cover[0] > 0.5
    overlap, alike = overlap_of(shown, covered, crop), likeness(shown, cover[0], crop)
    return Placement(pose, error, gain, overlap, alike, recall_of(covered, crop), covered)


def _unlike(
    poses: SE3, scores: Float[np.ndarray, " m"], count: int, *, distance: float, angle: float
) -> Int[np.ndarray, " count"]:
    """The best poses by score, each at least `distance` or `angle` (radians) from the better ones."""
    xyz, quat = np.asarray(poses.xyz), np.asarray(poses.quat)
    order = np.argsort(scores, kind="stable")
    chosen: list[int] = []
    for i in order:
        turned = 2 * np.arccos(np.clip(np.abs(quat[chosen] @ quat[i]), 0, 1))
        moved = np.linalg.norm(xyz[chosen] - xyz[i], axis=1)
        if np.all((turned > angle) | (moved > distance)):
            chosen.append(int(i))
        if len(chosen) == count:
            break
    return np.asarray(chosen + chosen[:1] * (count - len(chosen)))


def support_below(
    instance: Instance,
    surface: Float[np.ndarray, "n 3"],
    weights: Float[np.ndarray, " n"],
    vantage: Vantage,
    *,
    rng: np.random.Generator,
) -> Support | None:
    """The plane, among known surface points near an instance, that it stands on."""
    center = np.median(instance.points, axis=0)
    radius = np.quantile(np.linalg.norm(instance.points - center, axis=1), 0.95) + 1e-9
    near = np.linalg.norm(surface - center, axis=1) < 2.5 * radius
    return fit_support(surface[near], weights[near], instance.points, vantage, rng=rng)


def build_template(
    instance: Instance,
    support: Support | None,
    cones: Sequence[Cone],
    photographs: Sequence[Float[np.ndarray, "h w 3"]],
    *,
    identity: int,
    visit: int,
    coefficients: int,
    rng: np.random.Generator,
    config: TemplateConfig = TemplateConfig(),
) -> Template | None:
    """A new object's splats: the surface of its visual hull above its support, coloured by the photographs.

    Centres on the hull's boundary, identity rotation, spacing as scale, the paper's opacity; colour from the photograph
    that sees the point most squarely among those that see it. None when the outlines enclose nothing.
    """
    frame = support.frame() if support is not None else np.eye(3)
    grid = grid_around(instance.points, frame, resolution=config.hull_resolution)
    centers = grid.centers()
    outlines = [Cone(c.projection, r, c.valid, c.depth) for c, r in zip(cones, instance.regions, strict=True)]
    counts = carve(centers, outlines, tolerance=grid.voxel)
    solid = (counts[:, 0] >= max(1, min(2, instance.views))) & (counts[:, 1] == 0)
    if support is not None:
        solid &= support.height(centers) > -0.5 * grid.voxel
    solid = solid.reshape(grid.shape)
    labels = ndimage.label(solid, np.ones((3, 3, 3)))[0]
    if labels.max() == 0:
        return None
    largest = labels == 1 + np.argmax(np.bincount(labels.ravel())[1:])
    solid = largest.ravel()
    colors, spread = surface_evidence(centers, largest, outlines, photographs)
    if not np.isfinite(spread[solid]).any():
        return None
    likely = np.where(solid, np.exp(-0.5 * (spread / _AGREE) ** 2), 0)
    count = min(config.new_splats, int((likely > 0).sum()))
    index = np.sort(rng.choice(len(centers), count, replace=False, p=likely / likely.sum()))
    points, colors = centers[index], colors[index]
    spacing = (solid.sum() / count) ** (1 / 3) * grid.voxel
    n = len(points)
    sh = np.zeros((n, coefficients, 3), np.float32)
    sh[:, 0] = (colors - 0.5) / C0
    logit = np.log(config.new_opacity / (1 - config.new_opacity))
    splats = Splats(
        means=jnp.asarray(points, jnp.float32),
        quats=jnp.tile(quat_from_rotmat(jnp.eye(3, dtype=jnp.float32)), (n, 1)),
        log_scales=jnp.full((n, 3), np.log(0.7 * spacing), jnp.float32),
        logit_opacities=jnp.full(n, logit, jnp.float32),
        sh=jnp.asarray(sh),
    )
    return Template(splats, identity, visit)
