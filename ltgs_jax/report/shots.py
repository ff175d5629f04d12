"""Photographs on the page: before/after frames, and what each object looks like in them."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from html import escape

import numpy as np

from ltgs_jax.io import scaled_size

from .pictures import crop_box, difference, fitted, jpeg, overlay, read_ids, read_shown
from .run import Object, Run, Shot
from .words import ROLE_WORDS

_CROP_SIDE = 208  # twice the height at which crops are shown
_MOST_SHOTS = 120
_MOST_AT_SOURCE = 2


@dataclass(frozen=True)
class Crop:
    """An object in one photograph, beside the same place in the render; data URLs, empty when there is no render."""

    visit: int
    name: str
    pixels: int
    capture: str
    render: str


@dataclass
class Gallery:
    """Figures by visit, crops by object id, a thumbnail by visit, and how many photographs were left out for size."""

    figures: dict[int, list[str]] = field(default_factory=dict)
    crops: dict[int, list[Crop]] = field(default_factory=dict)
    thumbnails: dict[int, str] = field(default_factory=dict)
    left_out: int = 0


def make_gallery(run: Run) -> Gallery:
    """Read, shrink and embed the images of a run; the more there are, the smaller, so that the page stays portable."""
    chosen = _chosen(run.shots)
    side = 640 if len(chosen) <= 24 else 480 if len(chosen) <= 60 else 320
    gallery = Gallery(left_out=len(run.shots) - len(chosen))
    for shot in chosen:
        _add(gallery, shot, side)
    for thing in run.objects:
        if not any(crop.visit == thing.source_visit for crop in gallery.crops.get(thing.identity, [])):
            gallery.crops.setdefault(thing.identity, []).extend(_at_source(thing, chosen))
    for crops in gallery.crops.values():
        crops.sort(key=lambda crop: (crop.visit, -crop.pixels))
    return gallery


def _chosen(shots: Iterable[Shot]) -> list[Shot]:
    """Used photographs of later visits, then test ones, then the first visit's, up to the most that a page holds."""
    order = {"update": 0, "test": 1}
    ranked = sorted(shots, key=lambda shot: (shot.visit == 0, order.get(shot.role, 2)))[:_MOST_SHOTS]
    return sorted(ranked, key=lambda shot: (shot.visit, order.get(shot.role, 2), shot.name))


def _add(gallery: Gallery, shot: Shot, side: int) -> None:
    render = read_shown(shot.render)
    landscape = None if render is None else bool(render.shape[1] >= render.shape[0])
    capture = read_shown(shot.capture, landscape=landscape)
    reference = capture if capture is not None else render
    if reference is None:
        return
    size = scaled_size(reference.shape[1], reference.shape[0], side)
    images = {"capture": capture, "render": render, "initial": read_shown(shot.initial)}
    images = {layer: fitted(image, size) for layer, image in images.items() if image is not None}
    layers = {layer: jpeg(image) for layer, image in images.items()}
    if "capture" in images and "render" in images:
        layers["difference"] = jpeg(difference(images["capture"], images["render"]))
    ids = read_ids(shot.mask)
    if ids is not None and ids.any():
        layers["masks"] = overlay(ids, size)
        _add_crops(gallery, shot, ids, capture, render)
    gallery.figures.setdefault(shot.visit, []).append(_figure(shot, layers, size))
    if shot.visit not in gallery.thumbnails and "capture" in images:
        gallery.thumbnails[shot.visit] = jpeg(fitted(images["capture"], scaled_size(*size, 360)))


def _add_crops(gallery: Gallery, shot: Shot, ids: np.ndarray, capture, render) -> None:
    for identity in np.unique(ids[ids > 0]).tolist():
        box = crop_box(ids, identity)
        if capture is None or box is None:
            continue
        urls = ["" if image is None else jpeg(_cropped(image, box, ids.shape)) for image in (capture, render)]
        crop = Crop(shot.visit, shot.name, int((ids == identity).sum()), *urls)
        gallery.crops.setdefault(identity, []).append(crop)


def _at_source(thing: Object, shots: Iterable[Shot]) -> list[Crop]:
    """An object that no mask of its first visit shows: where its pose puts it, in the photographs that show it best."""
    found = []
    for shot in shots:
        box = _box_of(thing, shot) if shot.visit == thing.source_visit else None
        if box is not None:
            found.append(((box[1] - box[0]) * (box[3] - box[2]), box, shot))
    crops = []
    for pixels, box, shot in sorted(found, key=lambda entry: -entry[0])[:_MOST_AT_SOURCE]:
        capture, render = read_shown(shot.capture), read_shown(shot.render)
        if capture is not None and shot.camera is not None:
            shape = (shot.camera.height, shot.camera.width)
            urls = ["" if image is None else jpeg(_cropped(image, box, shape)) for image in (capture, render)]
            crops.append(Crop(shot.visit, shot.name, pixels, *urls))
    return crops


def _box_of(thing: Object, shot: Shot) -> tuple[int, int, int, int] | None:
    """Rows and columns around an object by its pose, in pixels of the camera; None unless it lies all in the image."""
    pose = thing.pose(shot.visit)
    if shot.camera is None or pose is None or not thing.visible(shot.visit):
        return None
    pixels, depths = shot.camera.project(pose.apply(thing.center[None]))
    depth = float(depths[0])
    if not depth > thing.size:
        return None
    column, row = np.asarray(pixels[0], float)
    reach = 0.6 * thing.size * float(shot.camera.K[0, 0]) / depth  # half the diagonal, and a margin
    top, bottom, left, right = row - reach, row + reach, column - reach, column + reach
    if top < 0 or left < 0 or bottom > shot.camera.height or right > shot.camera.width:
        return None
    return round(top), round(bottom), round(left), round(right)


def _cropped(image: np.ndarray, box: tuple[int, int, int, int], shape: tuple[int, ...]) -> np.ndarray:
    """The part of an image that `box`, given in pixels of a mask of `shape`, covers."""
    scale = np.array([image.shape[0] / shape[0]] * 2 + [image.shape[1] / shape[1]] * 2)
    top, bottom, left, right = np.rint(np.array(box) * scale).astype(int)
    part = image[top : max(bottom, top + 1), left : max(right, left + 1)]
    return fitted(part, scaled_size(part.shape[1], part.shape[0], _CROP_SIDE))


def _figure(shot: Shot, layers: dict[str, str], size: tuple[int, int]) -> str:
    views = [
        ("capture render", "photograph", "render", "photograph | render"),
        ("initial render", "first visit's scene", "render", "first visit's scene | render"),
        ("difference", "difference", "", "difference"),
    ]
    views = [view for view in views if all(layer in layers for layer in view[0].split())]
    only = next(iter(layers))
    below, above = [*views[0][0].split(), ""][:2] if views else (only, "")
    names = views[0][1:3] if views else (only, "")
    images = []
    for layer, url in layers.items():
        role = "below" if layer == below else "above" if layer == above else ""
        alt = escape(f"{layer} of {shot.name}")
        images.append(
            f'<img data-layer="{layer}" class="{role}" src="{url}" alt="{alt}" loading="lazy" draggable="false">'
        )
    buttons = [
        f'<button type="button" data-show="{show}" data-left="{left}" data-right="{right}" '
        f'aria-pressed="{"true" if i == 0 else "false"}">{label}</button>'
        for i, (show, left, right, label) in enumerate(views)
    ]
    if "masks" in layers:
        buttons.append('<button type="button" data-outline aria-pressed="false">objects</button>')
    return (
        f'<figure class="shot"><div class="frame{"" if above else " single"}" '
        f'style="aspect-ratio:{size[0]}/{size[1]}">{"".join(images)}<span class="bar"></span>'
        f'<span class="tag left">{names[0]}</span><span class="tag right">{names[1]}</span>'
        f'<input type="range" min="0" max="100" value="50" aria-label="Where the two images meet"></div>'
        f"<figcaption>{escape(shot.name)}{_scores(shot)}</figcaption>"
        f'<div class="buttons">{"".join(buttons)}</div></figure>'
    )


def _scores(shot: Shot) -> str:
    role = f" · {escape(ROLE_WORDS.get(shot.role, shot.role))}" if shot.role else ""
    if shot.psnr is None:
        return f'<span class="soft">{role}</span>'
    before = "" if shot.initial_psnr is None else f", first visit's scene {shot.initial_psnr:.1f}"
    return f'<span class="soft">{role} · PSNR {shot.psnr:.1f} dB{before}</span>'
