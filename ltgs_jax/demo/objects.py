"""The things on the table: a catalogue of textured objects, each in its own frame (middle of the footprint, z up)."""

import dataclasses
from collections.abc import Callable

import numpy as np

from . import textures as tx
from .shapes import Mesh, box, join, lathe, rectangle, surface, tube

CELL = 0.011
"""Spacing in metres of the vertices that hold the light."""
_TEXEL = 0.0018


@dataclasses.dataclass(frozen=True)
class Thing:
    """An object: its mesh and its extents [3] in metres."""

    name: str
    mesh: Mesh
    extents: np.ndarray

    @property
    def reach(self) -> float:
        """Radius of the footprint's circle in metres."""
        return float(np.hypot(*self.extents[:2]) / 2)


def _texels(*lengths: float) -> list[int]:
    return [max(8, round(length / _TEXEL)) for length in lengths]


def _carton(rng: np.random.Generator, scale: float) -> Mesh:
    w, d, h = scale * np.array([0.2, 0.085, 0.29])
    colors = tx.palette(rng)
    tw, td, th = _texels(w, d, h)
    faces = {
        "front": tx.packaging(rng, th, tw, colors, front=True),
        "right": tx.packaging(rng, th, td, colors, front=False),
        "back": tx.packaging(rng, th, tw, colors, front=False),
        "left": tx.packaging(rng, th, td, colors, front=True),
        "top": tx.cover(rng, td, tw, colors),
    }
    return box((w, d, h), faces, cell=CELL)


def _can(rng: np.random.Generator, scale: float) -> Mesh:
    r, h = scale * np.array([0.058, 0.16])
    colors = tx.palette(rng)
    around, high = _texels(2 * np.pi * r, h)
    metal = tx.plain(rng, 40, 90, (176, 178, 182))
    metal[::9] = 120
    return join(
        [
            lathe([(r, h), (r, 0)], tx.wrapped(rng, high, around, colors), cell=CELL),
            lathe([(0, h - 0.004), (r * 0.92, h - 0.004), (r, h)], metal, cell=CELL),
        ]
    )


def _mug(rng: np.random.Generator, scale: float) -> Mesh:
    r, h = scale * np.array([0.06, 0.125])
    colors = tx.palette(rng)
    around, high = _texels(2 * np.pi * r, h)
    glaze = tx.plain(rng, 60, 60, colors[1])
    angle = np.linspace(-0.42, 0.42, 18) * np.pi
    handle = np.stack([r * 0.97 + 0.62 * r * np.cos(angle), 0 * angle, h * (0.52 + 0.3 * np.sin(angle))], axis=-1)
    return join(
        [
            lathe([(r, h), (r, 0.012), (r * 0.9, 0)], tx.wrapped(rng, high, around, colors), cell=CELL),
            lathe([(r * 0.92, h), (r, h)], glaze, cell=CELL),
            lathe([(r * 0.92, h), (r * 0.92, 0.01)], glaze, cell=CELL, inside=True),
            lathe([(0, 0.01), (r * 0.92, 0.01)], tx.plain(rng, 30, 30, (92, 52, 30)), cell=CELL),
            tube(handle, 0.14 * r, tx.plain(rng, 40, 20, colors[0])),
        ]
    )


def _book(rng: np.random.Generator, scale: float) -> Mesh:
    w, d, h = scale * np.array([0.17, 0.23, 0.045])
    colors = tx.palette(rng)
    tw, td, th = _texels(w, d, h)
    edge = tx.pages(rng, th, tw)
    faces = {
        "front": edge,
        "right": tx.pages(rng, th, td),
        "back": edge[:, ::-1],
        "left": tx.packaging(rng, th, td, colors, front=False),
        "top": tx.cover(rng, td, tw, colors),
    }
    return box((w, d, h), faces, cell=CELL)


def _ball(rng: np.random.Generator, scale: float) -> Mesh:
    r = scale * 0.085
    polar = np.linspace(0, np.pi, 26)
    profile = np.stack([r * np.sin(polar), r + r * np.cos(polar)], axis=-1)
    profile[[0, -1], 0] = 0
    around, high = _texels(2 * np.pi * r, np.pi * r)
    return lathe(profile, tx.patches(rng, high, around, tx.palette(rng)), cell=CELL)


def _bottle(rng: np.random.Generator, scale: float) -> Mesh:
    r, h = scale * np.array([0.046, 0.3])
    colors = tx.palette(rng)
    around, high = _texels(2 * np.pi * r, 0.55 * h)
    shoulder = [(0.3 * r, 0.88 * h), (0.36 * r, 0.8 * h), (0.95 * r, 0.64 * h), (r, 0.6 * h)]
    return join(
        [
            lathe([(r, 0.6 * h), (r, 0)], tx.wrapped(rng, high, around, colors), cell=CELL),
            lathe(shoulder, tx.plain(rng, 60, 90, colors[2]), cell=CELL),
            lathe([(0.36 * r, h), (0.36 * r, 0.87 * h)], tx.plain(rng, 30, 60, colors[1]), cell=CELL),
            lathe([(0, h), (0.36 * r, h)], tx.plain(rng, 16, 30, colors[1]), cell=CELL),
        ]
    )


def _house(rng: np.random.Generator, scale: float) -> Mesh:
    w, d, h = scale * np.array([0.17, 0.15, 0.13])
    roof, over = scale * 0.085, scale * 0.012
    colors = tx.palette(rng)
    tw, td, th = _texels(w, d, h)
    walls = {
        face: tx.gable(rng, th, length, colors)
        for face, length in zip(("front", "right", "back", "left"), (tw, td) * 2, strict=True)
    }
    along, down = (w + 2 * over, 0, 0), (0, -d / 2 - over, -roof * (1 + 2 * over / d))
    roof_high, roof_wide = _texels(np.hypot(d / 2, roof), w)
    cladding = tx.tiles(rng, roof_high, roof_wide, colors[3])
    front = rectangle((-w / 2 - over, 0, h + roof), along, down, cladding, cell=CELL)
    turn = np.diag([-1.0, -1.0, 1.0, 1.0])
    gables = [_gable_end(sign * w / 2, d, h, roof, tx.plain(rng, 40, 60, (222, 200, 170)), sign) for sign in (1, -1)]
    return join([box((w, d, h), walls, cell=CELL), front, front.moved(turn), *gables])


def _gable_end(x: float, d: float, h: float, roof: float, texture: np.ndarray, sign: int) -> Mesh:
    """The triangle below the roof, as a grid that narrows to the ridge."""
    across = np.linspace(-1, 1, 16)[None, :] * sign
    rise = np.linspace(1, 0, 9)[:, None]
    points = np.stack([np.full((9, 16), x), d / 2 * across * (1 - rise), h + roof * rise + 0 * across], axis=-1)
    return surface(points, texture)


def _blocks(rng: np.random.Generator, scale: float) -> Mesh:
    side = scale * 0.085
    colors = tx.palette(rng)
    pixels = _texels(side)[0]
    parts = []
    for level, turn in ((0, 0.15), (1, -0.35)):
        faces = {face: tx.letter(rng, pixels, colors) for face in ("front", "right", "back", "left", "top")}
        cube = box((side, side, side), faces, cell=CELL)
        matrix = np.eye(4)
        matrix[:2, :2] = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
        matrix[2, 3] = level * side
        parts.append(cube.moved(matrix))
    return join(parts)


CATALOGUE: dict[str, Callable[[np.random.Generator, float], Mesh]] = {
    "carton": _carton,
    "can": _can,
    "mug": _mug,
    "book": _book,
    "ball": _ball,
    "bottle": _bottle,
    "house": _house,
    "blocks": _blocks,
}


def make_things(rng: np.random.Generator, count: int, *, first: tuple[str, ...] = ()) -> list[Thing]:
    """`count` different objects of the catalogue, those of `first` among them, in random sizes and colours."""
    others = [name for name in CATALOGUE if name not in first]
    names = [*first, *rng.permutation(others).tolist()][:count]
    things = []
    for name in names:
        mesh = CATALOGUE[name](rng, rng.uniform(0.95, 1.2))
        things.append(Thing(name, mesh, 2 * np.abs(mesh.vertices).max(axis=0) * [1, 1, 0.5]))
    return things
