"""What stands where at each visit: the scenes by name."""

import dataclasses

import numpy as np

from .objects import Thing, make_things
from .room import TABLE_SIZE, TABLE_TOP

SCENES = ("move", "turnover", "clutter", "nochange", "light")
VISITS = 4
_GAP = 0.035  # metres between the footprints' circles
_CLUTTER_GAP = -0.02  # circles may overlap a little: the things themselves then nearly touch
_FAR = 0.2  # metres that a moved thing moves at least
_TURN = np.radians([50.0, 130.0])


@dataclasses.dataclass(frozen=True)
class Spot:
    """A place: x, y and height in metres, turn about the vertical in radians."""

    x: float
    y: float
    z: float
    yaw: float

    def matrix(self) -> np.ndarray:
        """world_from_object [4 4]."""
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        return np.array([[c, -s, 0, self.x], [s, c, 0, self.y], [0, 0, 1, self.z], [0, 0, 0, 1.0]])


@dataclasses.dataclass(frozen=True)
class Story:
    """The things, and per visit where those that are present stand."""

    things: tuple[Thing, ...]
    visits: tuple[dict[str, Spot], ...]


class _Table:
    """Places things without collisions; the state of the table at the visit being told."""

    def __init__(self, rng: np.random.Generator, things: list[Thing], gap: float):
        self.rng, self.gap, self.spots = rng, gap, {}
        self.reach = {thing.name: thing.reach for thing in things}

    def put(self, name: str, *, away_from: Spot | None = None) -> None:
        """Give the thing a free spot, at least `_FAR` from where it was."""
        others = {other: spot for other, spot in self.spots.items() if other != name}
        reach = self.reach[name]
        room = np.array(TABLE_SIZE) * 0.45 - reach
        for _ in range(20000):
            x, y = self.rng.uniform(-room, room)
            if away_from is not None and np.hypot(x - away_from.x, y - away_from.y) < _FAR:
                continue
            if all(np.hypot(x - s.x, y - s.y) >= reach + self.reach[o] + self.gap for o, s in others.items()):
                self.spots[name] = Spot(float(x), float(y), TABLE_TOP, float(self.rng.uniform(-np.pi, np.pi)))
                return
        raise RuntimeError(f"no room on the table for {name}")

    def move(self, name: str) -> None:
        self.put(name, away_from=self.spots[name])

    def turn(self, name: str) -> None:
        angle = self.rng.uniform(*_TURN) * self.rng.choice([-1, 1])
        self.spots[name] = dataclasses.replace(self.spots[name], yaw=self.spots[name].yaw + float(angle))

    def stack(self, name: str, below: str, height: float) -> None:
        spot = self.spots[below]
        self.spots[name] = dataclasses.replace(spot, z=spot.z + height, yaw=float(self.rng.uniform(-np.pi, np.pi)))

    def remove(self, name: str) -> Spot:
        return self.spots.pop(name)


def tell(scene: str, rng: np.random.Generator) -> Story:
    """The story of a scene over four visits. Raises ValueError for an unknown scene."""
    if scene not in SCENES:
        raise ValueError(f"scene: expected one of {', '.join(SCENES)}, got {scene!r}")
    first = ("book",) if scene == "clutter" else ()
    things = make_things(rng, {"turnover": 6, "clutter": 7}.get(scene, 5), first=first)
    table = _Table(rng, things, _CLUTTER_GAP if scene == "clutter" else _GAP)
    teller = {"move": _move, "turnover": _turnover, "clutter": _clutter}.get(scene, _nothing)
    return Story(tuple(things), tuple(teller(table, things)))


def _nothing(table: _Table, things: list[Thing]):
    for thing in things:
        table.put(thing.name)
    for _ in range(VISITS):
        yield dict(table.spots)


def _move(table: _Table, things: list[Thing]):
    a, b, c, d, _ = (thing.name for thing in things)
    for thing in things:
        table.put(thing.name)
    yield dict(table.spots)
    table.move(a)
    yield dict(table.spots)
    table.move(b)
    table.turn(c)
    yield dict(table.spots)
    table.move(d)
    table.move(a)
    yield dict(table.spots)


def _turnover(table: _Table, things: list[Thing]):
    """Moved, removed, added; put back, turned; moved back, removed, moved. One thing never moves."""
    a, b, c, d, _, e = (thing.name for thing in things)
    for thing in things[:5]:
        table.put(thing.name)
    start = dict(table.spots)
    yield start
    left = table.remove(b)
    table.move(a)
    table.put(e)
    yield dict(table.spots)
    table.put(b, away_from=left)
    table.turn(c)
    yield dict(table.spots)
    table.remove(d)
    table.move(e)
    table.turn(a)
    yield dict(table.spots)


def _clutter(table: _Table, things: list[Thing]):
    """Things close together, one upon the book; the book moves with its burden, which is later taken down."""
    book, burden, c, d, e, f, late = things
    for thing in (book, c, d, e, f):
        table.put(thing.name)
    height = float(book.extents[2])
    table.stack(burden.name, book.name, height)
    yield dict(table.spots)
    carried = table.remove(burden.name)
    before = table.spots[book.name]
    table.move(book.name)
    after = table.spots[book.name]
    turned = carried.yaw + after.yaw - before.yaw
    table.spots[burden.name] = Spot(after.x, after.y, carried.z, turned)
    yield dict(table.spots)
    table.remove(c.name)
    table.move(d.name)
    yield dict(table.spots)
    table.spots.pop(burden.name)
    table.put(burden.name)
    table.put(late.name)
    yield dict(table.spots)
