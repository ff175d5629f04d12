"""Poses of a known template from what matches: its sides with the photographs, its surface with that of what came.

Beside the search over poses; which of them a template stands at, photometric evidence says.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from ltgs_jax.features import FrontEnd, inside, match_indices
from ltgs_jax.fit import template_diameter
from ltgs_jax.geometry import SE3, Camera
from ltgs_jax.localize import object_pose
from ltgs_jax.match import Instance
from ltgs_jax.register import RegisterConfig, Result, match_features, register
from ltgs_jax.template import Crop, Sides, points_of_depth, render_sides

from .config import Config
from .state import State

SIDE = 128  # pixels along the edge of the windows and renders that are matched
_ERROR = 4.0  # of those pixels, within which a match agrees with a pose
_SAME = 0.03  # sizes, within which keypoints of several sides are one place
_SURFACE = 600  # points of what came that are matched with the template's, and of these so many more
_MORE = 5
_TOLD = 128  # matches, best first, that are registered
_NOISE = 0.1  # sizes, by which the surface of a volume that outlines leave may be off


class Surface(eqx.Module):
    """What is known of a template's surface, for matches: points in its own frame with the descriptors of keypoints
    that sides of it show, points with dense descriptors (none, where nothing asks for them), and its diameter in scene
    units."""

    keypoints: Float[np.ndarray, "n 3"]
    descriptors: Float[np.ndarray, "n d"]
    points: Float[np.ndarray, "m 3"]
    features: Float[np.ndarray, "m e"]
    size: float


def surface_of(sides: Sides, front_end: FrontEnd, *, size: float, dense: bool) -> Surface:
    """The surface that a template shows from its sides, with `dense` descriptors or without."""
    points, descriptors = [], []
    for image, surface, firm in zip(sides.images, sides.points, sides.firm, strict=True):
        xy, described = front_end.keypoints(image)
        on = inside(xy, firm)
        columns, rows = np.floor(xy[on]).astype(int).T
        points.append(surface[rows, columns])
        descriptors.append(described[on])
    every = np.zeros((0, 3)), np.zeros((0, 1))
    if dense:
        every = _described(sides.images, sides.points, sides.firm, front_end, _MORE * _SURFACE)
    return Surface(np.concatenate(points), np.concatenate(descriptors), *every, size)


class Matcher:
    """Poses that matches propose for the templates of a state; the surface of each is looked at once."""

    def __init__(self, state: State, front_end: FrontEnd, config: Config) -> None:
        self._state, self._front_end, self._config = state, front_end, config
        self._surfaces: dict[int, Surface] = {}

    def poses(self, k: int, window: Crop, instance: Instance) -> dict[str, SE3]:
        """A pose [] of template k from each kind of matches that gives one, of those that the options ask for."""
        options, found = self._config.template, {}
        splats, support = self._state.chronology.templates[k].splats, self._state.supports[k]
        if support is None or not (options.matches or options.registration):
            return {}
        if k not in self._surfaces:
            size = template_diameter(splats)
            sides = render_sides(splats, support, size=size, side=SIDE)
            self._surfaces[k] = surface_of(sides, self._front_end, size=size, dense=options.registration)
        if options.matches:
            found["matches"] = pose_from_keypoints(self._surfaces[k], window, self._front_end)
        if options.registration:
            solver = self._config.register
            found["registration"] = pose_from_surface(self._surfaces[k], window, instance, self._front_end, solver)
        return {kind: pose for kind, pose in found.items() if pose is not None}


def pose_from_keypoints(known: Surface, window: Crop, front_end: FrontEnd, *, seed: int = 0) -> SE3 | None:
    """The pose [] at which most matches of a template's sides with all photographs of a visit at once agree (2D-3D);
    None where none has four. `window`: of the photographs around what came, `SIDE` pixels wide."""
    matches = [np.zeros((0, 6))]
    for v, (image, changed) in enumerate(zip(np.asarray(window.target), _changed(window), strict=True)):
        xy, descriptors = front_end.keypoints(image)
        on = inside(xy, changed)
        # As positions of keypoints, whose distances say which are of one place: 1.5 apart is no more than that.
        places = known.keypoints * (1.5 / (_SAME * known.size))
        rows, columns, _ = match_indices((xy[on], descriptors[on]), (places, known.descriptors))
        matches.append(np.c_[np.full(len(rows), v), xy[on][rows], known.keypoints[columns]])
    view, x, y, *point = np.concatenate(matches).T
    cameras, K = np.asarray(window.camera.cam_from_world.as_matrix(), np.float64), np.asarray(window.camera.K)
    found = object_pose(
        np.stack([x, y], axis=1), np.stack(point, axis=1), view.astype(int), cameras[:, :3], K,
        size=SIDE, max_error=_ERROR, seed=seed,
    )  # fmt: skip
    if found is None:
        return None
    return SE3.from_matrix(jnp.asarray(np.concatenate([found[0], [[0, 0, 0, 1]]]), jnp.float32))


def pose_from_surface(
    known: Surface, window: Crop, instance: Instance, front_end: FrontEnd, config: RegisterConfig
) -> SE3 | None:
    """The pose [] that takes a template's surface to the front of the volume that the outlines of what came leave, by
    registration of points whose dense descriptors match (3D-3D, section 3.3 of the LTGS paper); None where there is no
    consensus."""
    surface, shown = front_of(instance.points, window.camera)
    target = np.asarray(window.target)
    points, features = _described(target, surface, shown & _changed(window), front_end, _SURFACE)
    source, destination, _ = match_features(known.features, features)
    pairs = known.points[source[:_TOLD]], points[destination[:_TOLD]]
    found = register(*pairs, noise_bound=_NOISE * known.size, config=config)
    return SE3.from_matrix(found.dst_from_src.as_matrix()) if int(found.result) == Result.SUCCESS else None


def _changed(window: Crop) -> Bool[np.ndarray, "v s s"]:
    return np.asarray(window.region & window.valid)


def front_of(
    points: Float[np.ndarray, "n 3"], cameras: Camera
) -> tuple[Float[np.ndarray, "v s s 3"], Bool[np.ndarray, "v s s"]]:
    """The points in the world that the pixels of v cameras show of a volume given by points in it, and where they show
    any: the nearest within a pixel or two."""
    xy, z = cameras.project(jnp.asarray(points, jnp.float32))
    xy, z = np.asarray(xy, np.float64), np.asarray(z, np.float64)
    depth = np.full((len(z), cameras.height, cameras.width), np.inf, np.float32)
    for v, (place, away) in enumerate(zip(xy, z, strict=True)):
        column, row = np.floor(place).astype(int).T
        inside = (away > 0) & (row >= 0) & (row < cameras.height) & (column >= 0) & (column < cameras.width)
        np.minimum.at(depth[v], (row[inside], column[inside]), away[inside])
    depth = ndimage.minimum_filter(depth, (1, 5, 5))
    known = np.isfinite(depth)
    return points_of_depth(cameras, np.where(known, depth, 0)), known


def _described(images, points, shown, front_end: FrontEnd, most: int):
    """Points of a surface that images show, at most so many, with the dense descriptors of their pixels."""
    places, features = [], []
    for image, surface, mask in zip(images, points, shown, strict=True):
        dense = front_end.describe(image)
        middle = dense.stride * np.arange(len(dense.features)) + dense.stride // 2
        middle = middle[middle < len(mask)]
        seen = mask[np.ix_(middle, middle)]
        places.append(surface[np.ix_(middle, middle)][seen])
        features.append(dense.features[: len(middle), : len(middle)][seen])
    places, features = np.concatenate(places), np.concatenate(features)
    chosen = np.unique(np.linspace(0, len(places) - 1, min(most, len(places))).astype(int))
    return places[chosen], features[chosen]
