"""What happened to which object, in words."""

from collections import Counter
from dataclasses import dataclass

import numpy as np

from ltgs_jax.geometry import rotation_angle

from .run import CHANGES, Object, Run, State

EVENT_WORDS = {
    "still": "stayed",
    "moved": "moved",
    "added": "came",
    "removed": "went",
    "new_state": "changed its shape or look",
    "unseen": "was not seen",
}

ROLE_WORDS = {"train": "fitted", "update": "used", "test": "held out", "unused": "not used"}
SCORE_WORDS = {"psnr_initial": "psnr of the first visit's scene"}
_LEAST_TURN = 0.5  # degrees; less would read "turned 0°"
_POOR_DB = 20.0  # below, a render is a blur in which an object can come or go unseen


@dataclass(frozen=True)
class Happening:
    """One object at one visit: the event, the sentence without the object's name, the confidence."""

    thing: Object
    state: State
    sentence: str


def happenings(run: Run, visit: int) -> list[Happening]:
    """What happened at a visit: changes first, then what is there unseen; what stayed, or stays away, is left out."""
    found = [
        Happening(thing, thing.states[visit], _sentence(run, thing, thing.states[visit]))
        for thing in run.objects
        if visit in thing.states and _tells(thing.states[visit])
    ]
    return sorted(found, key=lambda entry: (entry.state.event not in CHANGES, entry.thing.identity))


def _tells(state: State) -> bool:
    return state.event in CHANGES or (state.event == "unseen" and state.visible)


def caution(run: Run, visit: int) -> str | None:
    """Why the changes of a visit are not to be relied on, where the scores say so."""
    rows = [row for row in run.metrics if row.get("visit") == run.visits[visit] and row.get("key") == "psnr_initial"]
    by_region = {row.get("region"): row.get("value") for row in rows}
    unchanged = by_region.get("static", by_region.get("full"))
    if not isinstance(unchanged, int | float) or unchanged >= _POOR_DB:
        return None
    return (
        "Even where nothing changed, the first visit's scene resembles these photographs poorly "
        f"({unchanged:.0f} dB): it is blurred, or the light is another. Changes may have been missed."
    )


def counted(run: Run, visit: int) -> str:
    """The changes of a visit in short: "2 moved, 1 went"."""
    counts = Counter(entry.state.event for entry in happenings(run, visit) if entry.state.event in CHANGES)
    words = {**EVENT_WORDS, "new_state": "changed"}
    return ", ".join(f"{counts[event]} {words[event]}" for event in CHANGES if counts[event]) or "nothing changed"


def movement(thing: Object, visit: int) -> tuple[float, float] | None:
    """Distance of the object's middle in scene units and angle in degrees since it was last seen; None if unknown."""
    before = [thing.pose(v) for v in range(visit) if thing.visible(v)]
    start = next((pose for pose in reversed(before) if pose is not None), None)
    after = thing.pose(visit)
    if start is None or after is None:
        return None
    places = [np.asarray(pose.apply(thing.center[None]))[0] for pose in (start, after)]
    angle = float(np.degrees(rotation_angle((start.inverse() @ after).quat)))
    return float(np.linalg.norm(places[1] - places[0])), angle


def _sentence(run: Run, thing: Object, state: State) -> str:
    words = EVENT_WORDS.get(state.event, state.event)
    moved = movement(thing, state.visit) if state.event in ("moved", "added") else None
    if moved is None:
        return words
    distance, angle = moved
    length = number(distance) + (f" ({distance / thing.size:.1f} × its size)" if thing.size > 0 else "")
    parts = [f"came back, {length} from where it was" if state.event == "added" else f"{words} by {length}"]
    if state.ambiguous_axis is None and angle >= _LEAST_TURN:
        parts.append(f"turned {angle:.0f}°")
    return ", ".join(parts)


def number(value: float) -> str:
    """A length with two significant digits, without an exponent where it can be helped."""
    return (
        f"{value:.2g}" if 1e-4 <= abs(value) < 100 or value == 0 else f"{value:.0f}" if value >= 100 else f"{value:.1e}"
    )


def summary(run: Run) -> str:
    """The whole run in one sentence."""
    rejected = sum(entry.status == "rejected" for entry in run.placements)
    counts = Counter(state.event for thing in run.objects for state in thing.states.values() if state.event in CHANGES)
    changes = sum(counts.values())
    later = all(not entry.name.startswith(f"{run.visits[0]}/") for entry in run.placements) if run.visits else False
    placed = "later photograph" if later else "photograph"  # those of the first visit are not always listed
    parts = [_count(len(run.visits), "visit"), _count(len(run.placements), placed)]
    if rejected:
        parts[-1] += f" ({rejected} left out)"
    parts += [_count(len(run.objects), "object"), _count(changes, "change")]
    seconds = sum(float(stage.get("seconds") or 0) for stage in run.stages)
    if seconds:
        parts.append(duration(seconds))
    return ", ".join(parts)


def duration(seconds: float) -> str:
    """Seconds as a person says them."""
    return f"{seconds:.1f} s" if seconds < 60 else f"{int(seconds // 60)} min {int(seconds % 60)} s"


def _count(count: int, noun: str) -> str:
    return f"{count} {noun}" + ("" if count == 1 else "s")
