"""The room that stays: walls, floor, a table, and what hangs and stands about."""

import dataclasses

import numpy as np

from . import textures as tx
from .shapes import Mesh, box, join, lathe, rectangle

TABLE_TOP = 0.74
"""Height of the table's surface in metres."""
TABLE_SIZE = (1.34, 0.92)
_WEST, _EAST, _SOUTH, _NORTH, _CEILING = -2.1, 2.1, -2.5, 1.15, 2.5


@dataclasses.dataclass(frozen=True)
class Light:
    """A rectangular lamp: its corner and sides in metres, the way it shines, its radiance (RGB)."""

    corner: np.ndarray
    sides: np.ndarray
    normal: np.ndarray
    radiance: np.ndarray


def make_lights(rng: np.random.Generator) -> list[Light]:
    """A lamp at the ceiling and a window to one side."""
    x, y = rng.choice([-1, 1]) * rng.uniform(0.7, 1.1) - 0.25, rng.uniform(-1.1, -0.3)
    lamp = Light(
        corner=np.array([x, y, _CEILING - 0.05]),
        sides=np.array([[0.5, 0, 0], [0, 0.42, 0]]),
        normal=np.array([0.0, 0.0, -1.0]),
        radiance=np.array([1.0, 0.94, 0.84]) * 30.0,
    )
    east = rng.random() < 0.5
    window = Light(
        corner=np.array([_EAST - 0.02 if east else _WEST + 0.02, -1.6, 1.1]),
        sides=np.array([[0, 1.1, 0], [0, 0, 0.9]]),
        normal=np.array([-1.0 if east else 1.0, 0.0, 0.0]),
        radiance=np.array([0.82, 0.92, 1.08]) * 4.5,
    )
    return [lamp, window]


def make_room(rng: np.random.Generator) -> Mesh:
    """The static scene: its table stands at the origin, x to the right and y away from the dense arc's middle."""
    colors = tx.palette(rng, 5)
    width, depth, height = _EAST - _WEST, _NORTH - _SOUTH, _CEILING
    paper = tx.wallpaper(rng, 400, 680, colors)
    ceiling = tx.plain(rng, 60, 60, (225, 222, 215), strength=4)
    floor = tx.wood(rng, 420, 480, planks=16, color=(150, 108, 70))
    parts = [
        rectangle((_WEST, _NORTH, 0), (width, 0, 0), (0, -depth, 0), floor, cell=0.06),
        rectangle((_WEST, _SOUTH, height), (width, 0, 0), (0, depth, 0), ceiling, cell=0.3),
        rectangle((_WEST, _NORTH, height), (width, 0, 0), (0, 0, -height), paper, cell=0.06),
        rectangle((_EAST, _NORTH, height), (0, -depth, 0), (0, 0, -height), paper, cell=0.08),
        rectangle((_WEST, _SOUTH, height), (0, depth, 0), (0, 0, -height), paper, cell=0.08),
        rectangle((_EAST, _SOUTH, height), (-width, 0, 0), (0, 0, -height), paper, cell=0.2),
        *_table(rng),
        *_wall_decoration(rng),
        _shelf(rng),
    ]
    rug = tx.rug(rng, 300, 420, colors)
    parts.append(rectangle((-1.35, 0.55, 0.008), (2.7, 0, 0), (0, -1.9, 0), rug, cell=0.05))
    pot = [(0.13, 0.34), (0.16, 0.3), (0.11, 0.0)]
    plant = [(0.0, 0.98), (0.16, 0.8), (0.24, 0.62), (0.2, 0.45), (0.1, 0.36)]
    for profile, texture in ((pot, tx.wallpaper(rng, 80, 200, colors[1:])), (plant, _leaves(rng))):
        corner = np.eye(4)
        corner[:3, 3] = (-1.7, 0.8, 0.0)
        parts.append(lathe(profile, texture, cell=0.03, segments=24).moved(corner))
    return join(parts)


def _table(rng: np.random.Generator) -> list[Mesh]:
    (w, d), thickness = TABLE_SIZE, 0.035
    top = tx.wood(rng, 460, 670, planks=5, color=(176, 138, 96))
    edge = tx.wood(rng, 20, 400, planks=1, color=(140, 104, 70))
    faces = {"top": top, "front": edge, "back": edge, "left": edge, "right": edge}
    parts = [box((w, d, thickness), faces, cell=0.014, base=(0, 0, TABLE_TOP - thickness))]
    for x in (-w / 2 + 0.06, w / 2 - 0.06):
        for y in (-d / 2 + 0.06, d / 2 - 0.06):
            legs = {face: edge.swapaxes(0, 1) for face in ("front", "back", "left", "right")}
            parts.append(box((0.06, 0.06, TABLE_TOP - thickness), legs, cell=0.04, base=(x, y, 0)))
    mat = tx.rug(rng, 150, 220, tx.palette(rng))
    x, y = rng.uniform(-0.28, 0.02), rng.uniform(0.0, 0.1)
    parts.append(rectangle((x - 0.22, y + 0.15, TABLE_TOP + 0.002), (0.44, 0, 0), (0, -0.3, 0), mat, cell=0.014))
    return parts


def _wall_decoration(rng: np.random.Generator) -> list[Mesh]:
    """Framed pictures on the three walls that are seen."""
    wood = tx.wood(rng, 30, 200, planks=1, color=(90, 62, 40))
    frames = []
    places = ((-1.35, 1.25, 0.8, 0.62), (0.95, 1.3, 0.62, 0.75))
    for x, z, w, h in places:
        frames.append(_framed(rng, wood, (x, _NORTH, z), (1, 0, 0), (w, h)))
    frames.append(_framed(rng, wood, (_EAST, 0.55, 1.05), (0, -1, 0), (1.0, 0.75)))
    frames.append(_framed(rng, wood, (_WEST, -1.0, 1.05), (0, 1, 0), (1.0, 0.75)))
    return frames


def _framed(rng: np.random.Generator, wood: np.ndarray, corner, right, size: tuple[float, float]) -> Mesh:
    """A picture whose lower left corner is given, on a wall with that direction to the right."""
    right = np.asarray(right, dtype=np.float64)
    normal = np.cross(right, [0, 0, 1])
    (w, h), border = size, 0.045
    corner = np.add(corner, [0, 0, h])
    outer = corner + 0.012 * normal - border * right + [0, 0, border]
    art = tx.picture(rng, round(h * 190), round(w * 190))
    return join(
        [
            rectangle(outer, (w + 2 * border) * right, (0, 0, -h - 2 * border), wood, cell=0.08),
            rectangle(corner + 0.016 * normal, w * right, (0, 0, -h), art, cell=0.08),
        ]
    )


def _shelf(rng: np.random.Generator) -> Mesh:
    """A board on the far wall with a row of books."""
    board = tx.wood(rng, 40, 300, planks=1, color=(120, 86, 56))
    depth, z = 0.2, 1.28
    y = _NORTH - depth / 2
    parts = [
        box(
            (1.0, depth, 0.03),
            dict.fromkeys(("front", "left", "right", "top", "bottom"), board),
            cell=0.04,
            base=(0.25, y, z),
        )
    ]
    x = -0.2
    while x < 0.62:
        w, h = rng.uniform(0.035, 0.075), rng.uniform(0.17, 0.27)
        colors = tx.palette(rng)
        spine = tx.packaging(rng, round(h * 420), max(16, round(w * 420)), colors, front=False)
        side = tx.plain(rng, 60, 40, colors[0])
        faces = {"front": spine, "left": side, "right": side, "top": side}
        parts.append(box((w, 0.15, h), faces, cell=0.04, base=(x + w / 2, y, z + 0.03)))
        x += w + 0.004
    return join(parts)


def _leaves(rng: np.random.Generator) -> np.ndarray:
    green = tx.plain(rng, 160, 240, (60, 110, 55), strength=20)
    light = tx.clouds(rng, 160, 240, coarsest=30, octaves=2)
    return np.clip(green + 45 * light[..., None] * [0.7, 1, 0.5], 0, 255).astype(np.uint8)
