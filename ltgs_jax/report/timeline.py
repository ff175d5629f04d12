"""The drawn timeline: a row for each object, a column for each visit."""

from html import escape

from .pictures import css_color
from .run import Object, Run
from .words import EVENT_WORDS

_ROW, _LEFT, _TOP = 34, 96, 40
_MARKS = {
    "still": '<circle r="4"/>',
    "moved": '<path d="M-8 -6 L6 0 L-8 6 Z"/>',
    "added": '<path d="M-2 -8h4v6h6v4h-6v6h-4v-6h-6v-4h6z"/>',
    "removed": '<path d="M-7 -7L7 7M7 -7L-7 7" fill="none" stroke-width="3"/>',
    "new_state": '<rect x="-6" y="-6" width="12" height="12"/>',
    "unseen": '<circle r="4" fill="none" stroke-width="2"/>',
}


def timeline(run: Run) -> str:
    """An SVG: a line while an object is there (dashed: taken to be, unseen; pale: until it went), marks for events."""
    column = max(72, min(150, 640 // max(1, len(run.visits))))
    width = _LEFT + column * len(run.visits)
    height = _TOP + _ROW * len(run.objects)
    parts = [
        f'<svg class="timeline" viewBox="0 0 {width} {height}" width="{width}" height="{height}" role="img" '
        f'aria-label="Timeline of {len(run.objects)} objects over {len(run.visits)} visits">'
    ]
    for visit, name in enumerate(run.visits):
        x = _LEFT + column * (visit + 0.5)
        shown = name if len(name) * 7.5 < column else f"{name[: int(column / 7.5) - 1]}…"
        parts.append(f'<text x="{x}" y="18" text-anchor="middle">{escape(shown)}<title>{escape(name)}</title></text>')
        parts.append(f'<line class="grid" x1="{x}" x2="{x}" y1="{_TOP - 14}" y2="{height}"/>')
    for row, thing in enumerate(run.objects):
        parts.append(_row(run, thing, _TOP + _ROW * (row + 0.5), column))
    return "".join([*parts, "</svg>"])


def _row(run: Run, thing: Object, y: float, column: int) -> str:
    color = css_color(thing.identity)
    parts = [
        f'<g transform="translate(0 {y})" fill="{color}" stroke="{color}">',
        f'<a href="#object-{thing.identity}"><text x="4" y="5" stroke="none">object {thing.identity}</text></a>',
    ]
    x_of = [_LEFT + column * (visit + 0.5) for visit in range(len(run.visits))]
    for visit in range(1, len(run.visits)):
        event = thing.states[visit].event if visit in thing.states else "still"
        if thing.visible(visit - 1) and (thing.visible(visit) or event == "removed"):
            style = {"unseen": ' stroke-dasharray="3 5"', "removed": ' opacity="0.35"'}.get(event, "")
            parts.append(f'<line x1="{x_of[visit - 1]}" x2="{x_of[visit]}" y1="0" y2="0" stroke-width="4"{style}/>')
    for visit, x in enumerate(x_of):
        state = thing.states.get(visit)
        event = "still" if state is None else state.event
        if event in ("still", "unseen") and not thing.visible(visit):
            continue
        words = "is there" if state is None else EVENT_WORDS.get(event, event)
        title = f"object {thing.identity} {words} at {run.visits[visit]}"
        parts.append(f'<g transform="translate({x} 0)">{_MARKS.get(event, _MARKS["still"])}')
        parts.append(f"<title>{escape(title)}</title></g>")
    return "".join([*parts, "</g>"])


def legend() -> str:
    """What the marks mean."""
    entries = []
    for event, mark in _MARKS.items():
        box = 'viewBox="-10 -10 20 20" width="16" height="16"'
        icon = f'<svg {box} fill="currentColor" stroke="currentColor">{mark}</svg>'
        entries.append(f"<span>{icon} {escape(EVENT_WORDS[event])}</span>")
    return f'<p class="legend">{"".join(entries)}</p>'
