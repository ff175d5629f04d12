"""One self-contained page of results: no other file, no network."""

import json
from collections import Counter
from collections.abc import Sequence
from html import escape
from importlib.resources import files
from pathlib import Path
from typing import Any

from ltgs_jax.io import load_chronology, write_bytes

from .pictures import css_color, webp
from .run import Object, Placement, Run, read_run
from .shots import Gallery, make_gallery
from .timeline import legend, timeline
from .turntable import turntable, up_direction
from .words import SCORE_WORDS, Happening, caution, counted, duration, happenings, number, summary

_LOW_CONFIDENCE = 0.5
_MOST_CROPS = 8


def write_report(folder: str | Path) -> Path:
    """Write `report.html` from what is in the folder of a chronology (contract.md, "Out"); returns its path.

    Images are found through `report.json`: {"photographs": [{"name", "visit", "role", "capture_path", "render_path",
    "initial_render_path", "mask_path", "psnr", "initial_psnr"}]}, paths absolute or relative to the folder; anything
    but name and visit may be missing.

    Raises InputError that names the file when one is not what it should be, or the page cannot be written.
    """
    folder = Path(folder)
    run, path = read_run(folder), folder / "report.html"
    write_bytes(path, page(run, make_gallery(run), _sides(folder, run)).encode())
    return path


def _sides(folder: Path, run: Run) -> dict[int, list[str]]:
    """Data URLs of each object alone, by id; its last template where it has several."""
    if not (folder / "chronology.safetensors").exists():
        return {}
    chronology = load_chronology(folder)
    images = turntable(chronology, up_direction([shot.camera for shot in run.shots if shot.camera is not None]))
    pairs = zip(chronology.templates, images, strict=True)
    return {template.identity: [webp(image) for image in views] for template, views in pairs}


def page(run: Run, gallery: Gallery, sides: dict[int, list[str]]) -> str:
    """The whole HTML text."""
    sections = [
        ("visits", "Visits", _strip(run, gallery)),
        ("happened", "What happened", _happened(run)),
        ("timeline", "Timeline", _timeline(run)),
        ("objects", "Objects", _objects(run, gallery, sides)),
        ("photographs", "Photographs", _photographs(run, gallery)),
        ("scores", "Scores", _scores(run.metrics)),
        ("ledger", "What each visit added", _ledger(run.stages)),
        ("stages", "Time and memory", _stages(run.stages)),
        ("cameras", "Cameras", _cameras(run.placements)),
        ("options", "Options and versions", _options(run)),
    ]
    sections = [(anchor, title, body) for anchor, title, body in sections if body]
    links = "".join(f'<a href="#{anchor}">{title}</a>' for anchor, title, _ in sections)
    bodies = "".join(f'<section id="{anchor}"><h2>{title}</h2>{body}</section>' for anchor, title, body in sections)
    title = f"What changed: {run.capture}"
    static = files("ltgs_jax.report") / "static"
    css, script = ((static / name).read_text(encoding="utf-8") for name in ("report.css", "report.js"))
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f'<title>{escape(title)}</title><link rel="icon" href="data:,"><style>{css}</style></head><body><main>'
        f'<h1>{escape(title)}</h1><p>{escape(summary(run))}</p><nav aria-label="Sections">{links}</nav>{bodies}'
        f"</main><script>{script}</script></body></html>\n"
    )


def _strip(run: Run, gallery: Gallery) -> str:
    cards = []
    for visit, name in enumerate(run.visits):
        url = gallery.thumbnails.get(visit)
        picture = f'<img src="{url}" alt="">' if url else '<div class="none"></div>'
        words = "first visit" if visit == 0 else counted(run, visit)
        target = f"#visit-{visit}" if visit in gallery.figures else "#happened"
        caption = f'<div><b>{escape(name)}</b><span class="soft">{words}</span></div>'
        cards.append(f'<a class="card" href="{target}">{picture}{caption}</a>')
    return f'<div class="strip">{"".join(cards)}</div>'


def _happened(run: Run) -> str:
    parts = []
    for visit, name in enumerate(run.visits):
        if visit == 0:
            continue
        entries = "".join(f"<li>{_happening(run, entry)}</li>" for entry in happenings(run, visit))
        body = f'<ul class="happened">{entries}</ul>' if entries else '<p class="soft">Nothing changed.</p>'
        warning = caution(run, visit)
        told = f'<p class="caution">{escape(warning)}</p>' if warning else ""
        parts.append(f"<h3>{escape(name)}</h3>{body}{told}")
    return "".join(parts)


def _happening(run: Run, entry: Happening) -> str:
    first = run.visits[entry.thing.source_visit]
    seen = "" if entry.state.event == "added" and entry.sentence == "came" else f" (first seen at {escape(first)})"
    sentence = f"<span>{_name(entry.thing)}<span class='soft'>{seen}</span> {escape(entry.sentence)}</span>"
    return sentence + _confidence(entry.state.confidence)


def _name(thing: Object) -> str:
    swatch = f'<span class="swatch" style="background:{css_color(thing.identity)}"></span>'
    return f'{swatch}<a href="#object-{thing.identity}"><b>object {thing.identity}</b></a>'


def _confidence(value: float | None) -> str:
    if value is None:
        return ""
    low = " low" if value < _LOW_CONFIDENCE else ""
    return f' <span class="confidence{low}">confidence {value:.2f}</span>'


def _timeline(run: Run) -> str:
    return f'<div class="card scroll">{timeline(run)}</div>{legend()}' if run.objects else ""


def _objects(run: Run, gallery: Gallery, sides: dict[int, list[str]]) -> str:
    if not run.objects:
        return '<p class="soft">No object was found to change.</p>'
    cards = []
    for thing in run.objects:
        facts = (
            f"first seen at {escape(run.visits[thing.source_visit])}, {thing.splats} splats, size {number(thing.size)}"
        )
        axes = {escape(str(s.ambiguous_axis)) for s in thing.states.values() if s.ambiguous_axis is not None}
        if axes:
            facts += f"; looks the same turned about {', '.join(sorted(axes))}"
        alone = "".join(
            f'<img src="{url}" alt="object {thing.identity} alone" loading="lazy">'
            for url in sides.get(thing.identity, [])
        )
        crops = gallery.crops.get(thing.identity, [])[:_MOST_CROPS]
        figures = "".join(
            f'<figure><div><img src="{crop.capture}" alt="photograph" loading="lazy">'
            + (f'<img src="{crop.render}" alt="render" loading="lazy">' if crop.render else "")
            + f"</div><figcaption>{escape(crop.name)}</figcaption></figure>"
            for crop in crops
        )
        cards.append(
            f'<div class="card" id="object-{thing.identity}"><h3>{_name(thing)}</h3><p class="soft">{facts}</p>'
            + (f'<div class="alone">{alone}</div>' if alone else "")
            + (f'<div class="crops">{figures}</div>' if figures else "")
            + "</div>"
        )
    words = "Each alone, from four sides; then cut out of the photographs, with the render beside."
    return f'<p class="soft">{words}</p><div class="objects">{"".join(cards)}</div>'


def _photographs(run: Run, gallery: Gallery) -> str:
    parts = []
    for visit, figures in sorted(gallery.figures.items()):
        parts.append(
            f'<h3 id="visit-{visit}">{escape(run.visits[visit])}</h3><div class="shots">{"".join(figures)}</div>'
        )
    if gallery.left_out:
        parts.append(f'<p class="soft">{gallery.left_out} more photographs are not shown, to keep this page small.</p>')
    return "".join(parts)


def _scores(rows: Sequence[dict]) -> str:
    """One line per visit and region, one column per score; an arrow says which way is better."""
    if not rows:
        return ""
    keys = {row["key"]: row for row in rows}
    heads = ["visit", "region"]
    for key, row in keys.items():
        unit = "" if row.get("unit") in (None, "", "1") else f" ({row['unit']})"
        heads.append(f"{SCORE_WORDS.get(key, key)}{unit} {'↑' if row.get('direction') == 'higher' else '↓'}")
    values = {(row.get("visit"), row.get("region"), row["key"]): row.get("value") for row in rows}
    body = []
    for visit, region in dict.fromkeys((row.get("visit"), row.get("region")) for row in rows):
        cells: list[Any] = ["all" if visit is None else visit, region or ""]
        body.append([*cells, *(_number(values.get((visit, region, key))) for key in keys)])
    return _table(heads, body)


def _ledger(stages: Sequence[dict]) -> str:
    """What each visit added, in numbers and bytes, and what that bought."""
    counts = next((row.get("counts") for row in stages if row.get("stage") == "ledger"), None)
    listed = counts.get("ledger") if isinstance(counts, dict) else None
    rows = [row for row in listed if isinstance(row, dict)] if isinstance(listed, list) else []
    if not rows:
        return ""
    heads = ["visit", "what", "numbers added", "KiB", "dB bought", "pose by"]
    body = [
        [
            str(row.get("visit", "")),
            str(row.get("what", "")),
            row.get("parameters"),
            None if (size := _number(row.get("bytes"))) is None else _Cell(f"{size / 1024:.1f}", size),
            _number(row.get("gain_db")),
            str(row.get("evidence") or ""),
        ]
        for row in rows
    ]
    kinds = Counter(str(row["evidence"]) for row in rows if row.get("evidence"))
    won = ", ".join(f"{count} by {kind}" for kind, count in kinds.most_common())
    words = (
        "dB: PSNR over the photographs of the visit, whole, less that without this one thing (an object as it was at "
        "the visit before). They are the photographs that it was fitted to."
    )
    words += f" Poses of known objects: {escape(won)}." if won else ""
    return f'<p class="soft">{words}</p>{_table(heads, body)}'


def _number(value: Any) -> float | None:
    try:
        return float(value) if isinstance(value, int | float) else None
    except OverflowError:  # JSON has integers beyond any float
        return None


def _stages(rows: Sequence[dict]) -> str:
    if not rows:
        return ""
    longest = max(_number(row.get("seconds")) or 0 for row in rows) or 1
    body = []
    for row in rows:
        seconds = _number(row.get("seconds")) or 0
        bar = f'<span class="meter" style="width:{100 * seconds / longest:.1f}%"></span>'
        counts = row.get("counts")
        plain = counts.items() if isinstance(counts, dict) else ()
        listed = ", ".join(f"{key} {value}" for key, value in plain if not isinstance(value, list))
        peak = _number(row.get("peak_bytes"))
        body.append(
            [
                str(row.get("stage", row.get("name", ""))),
                _Cell(f"{seconds:.1f} {bar}", seconds),
                _number(row.get("compile_seconds")),
                None if peak is None else _Cell(f"{peak / 2**20:.0f} MiB", peak),
                "from disk" if row.get("resumed") else str(row.get("status", "")),
                listed,
            ]
        )
    total = sum(_number(row.get("seconds")) or 0 for row in rows)
    heads = ["stage", "seconds", "of it compiling", "peak memory", "status", "counts"]
    return f'<p class="soft">{duration(total)} in all.</p>{_table(heads, body)}'


def _cameras(placements: Sequence[Placement]) -> str:
    if not placements:
        return ""
    rejected = [entry for entry in placements if entry.status == "rejected"]
    listed = "".join(f"<li><b>{escape(e.name)}</b>: {escape(e.reason or 'no reason given')}</li>" for e in rejected)
    words = f"<p>Left out:</p><ul>{listed}</ul>" if rejected else "<p>Every photograph was placed.</p>"
    body = []
    for entry in placements:
        status = f'<span class="rejected">{entry.status}</span>' if entry.status == "rejected" else escape(entry.status)
        body.append([entry.name, _Cell(status, entry.status), entry.inliers, entry.reason or ""])
    table = _table(["photograph", "pose", "inliers", "reason"], body)
    return f"{words}<details><summary>All {len(placements)} photographs</summary>{table}</details>"


def _options(run: Run) -> str:
    parts = [(name, value) for name, value in (("Options", run.config), ("Versions and device", run.env)) if value]
    return "".join(
        f"<details><summary>{name}</summary><pre>{escape(json.dumps(value, indent=1))}</pre></details>"
        for name, value in parts
    )


class _Cell(str):
    """HTML of a cell that sorts by `value`."""

    value: Any

    def __new__(cls, markup: str, value: Any) -> "_Cell":
        cell = super().__new__(cls, markup)
        cell.value = value
        return cell


def _table(heads: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    numeric = [any(_is_number(row[i]) for row in rows) for i in range(len(heads))]
    head = "".join(
        f"<th{_class(is_number)}>{escape(text)}</th>" for text, is_number in zip(heads, numeric, strict=True)
    )
    body = []
    for row in rows:
        cells = []
        for value, is_number in zip(row, numeric, strict=True):
            if isinstance(value, _Cell):
                shown, key = str(value), value.value
            elif isinstance(value, float):
                shown, key = f"{value:.3f}", value
            elif value is None:
                shown, key = "–", ""
            else:
                shown, key = escape(str(value)), value
            cells.append(f'<td{_class(is_number)} data-value="{escape(str(key))}">{shown}</td>')
        body.append(f"<tr>{''.join(cells)}</tr>")
    table = f"<table data-sortable><thead><tr>{head}</tr></thead><tbody>{''.join(body)}</tbody></table>"
    return f'<div class="scroll">{table}</div>'


def _is_number(cell: Any) -> bool:
    """Whether a cell shows a number and nothing drawn beside it."""
    value = cell.value if isinstance(cell, _Cell) and "<" not in cell else cell
    return isinstance(value, int | float)


def _class(is_number: bool) -> str:
    return ' class="number"' if is_number else ""
