"""Which windows the steps of the long fit look at, and when it ends."""

from collections.abc import Sequence

import jax
import numpy as np
from jaxtyping import Bool, PyTree

from .windows import Window

_TILE = 8  # side in pixels of the squares that are held out
_HELD_OUT = 1 / 16  # of the squares of every picture
_FIRST = 0.5  # share of the first visit in what is replayed, where later ones were fitted before
_PATIENCE = 0.3  # share of the passes that may, one after the other, come out no better than the best before


def held_out(shape: tuple[int, int], rng: np.random.Generator) -> Bool[np.ndarray, "h w"]:
    """Squares of a picture that nothing is fitted to."""
    tiles = rng.random([-(-side // _TILE) for side in shape]) < _HELD_OUT
    return tiles.repeat(_TILE, axis=0).repeat(_TILE, axis=1)[: shape[0], : shape[1]]


class Draws:
    """Windows at random, all of a kind before any of it again: those of visits `since` and later, and for a share of
    the draws, `replay`, those of the first visit and of the ones between, half and half where there are both."""

    def __init__(self, windows: Sequence[Window], *, since: int, replay: float, rng: np.random.Generator) -> None:
        visits = np.asarray([w.visit for w in windows], int)
        self.later = np.flatnonzero(visits >= max(since, 1)).tolist()
        self.first = np.flatnonzero(visits == 0).tolist()
        self.seen = np.flatnonzero((visits > 0) & (visits < since)).tolist()
        self._replay = replay if self.first or self.seen else 0.0
        self._rng = rng
        self._queues: dict[str, list[int]] = {"later": [], "first": [], "seen": []}

    def steps(self, passes: int, batch: int) -> int:
        """How many steps look at every later window so often."""
        steps = round(passes * len(self.later) / max(1 - self._replay, 0.1) / batch)
        return max(steps, 1) if self.later else 0

    def draw(self) -> int:
        """The next window's index."""
        name, every = "later", self.later
        if self._rng.random() < self._replay:
            of_first = self.first and (not self.seen or self._rng.random() < _FIRST)
            name, every = ("first", self.first) if of_first else ("seen", self.seen)
        queue = self._queues[name]
        if not queue:
            queue.extend(self._rng.permutation(every).tolist())
        return queue.pop()


class Watch:
    """What came out best so far by the error of what is held out, looked at whenever as many windows that hold some out
    were drawn as there are (`every`)."""

    def __init__(self, variables: PyTree, *, every: int, passes: int) -> None:
        self.best = jax.tree.map(np.array, variables)
        self._every, self._patience = every, _PATIENCE * passes
        self._errors, self._sum, self._drawn = [np.inf], 0.0, 0

    def over(self, variables: PyTree, *, error: float, drawn: int) -> bool:
        """Whether to stop after a step: `error` summed over its windows, of which so many hold some out."""
        self._sum, self._drawn = self._sum + error, self._drawn + drawn
        if self._drawn < self._every:
            return False
        self._errors.append(self._sum / self._drawn)
        self._sum, self._drawn = 0.0, 0
        if self._errors[-1] == min(self._errors):
            self.best = jax.tree.map(np.array, variables)
            return False
        return len(self._errors) - 1 - self.passes >= self._patience

    @property
    def passes(self) -> int:
        """After how many looks the best came out."""
        return int(np.argmin(self._errors))
