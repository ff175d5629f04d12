"""Images made small enough to be carried inside the page."""

import base64
import colorsys
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, Integer, UInt8

from ltgs_jax.io import InputError
from ltgs_jax.io.images import as_rgb, read_pixels

_JPEG_QUALITY = 80
_SATURATED_DIFFERENCE = 0.4  # mean absolute difference over channels that is drawn at full strength


def color_of(identity: int) -> tuple[int, int, int]:
    """An sRGB colour for an object id; successive ids lie a golden angle of hue apart."""
    red, green, blue = colorsys.hls_to_rgb((identity * 0.381966) % 1, 0.52, 0.75)
    return round(red * 255), round(green * 255), round(blue * 255)


def css_color(identity: int) -> str:
    """The same as `#rrggbb`."""
    return "#{:02x}{:02x}{:02x}".format(*color_of(identity))


def read_shown(path: Path | None, *, landscape: bool | None = None) -> Float[np.ndarray, "h w 3"] | None:
    """An image in 0..1, None when it is missing or cannot be read.

    `landscape` says which way the image lies that it goes with: when the stored one lies the other way, the EXIF
    orientation is applied.
    """
    if path is None:
        return None
    try:
        image = as_rgb(read_pixels(path))
        if landscape is not None and (image.shape[1] >= image.shape[0]) != landscape:
            image = as_rgb(read_pixels(path, oriented=True))
    except InputError:
        return None
    return image


def read_ids(path: Path | None) -> Integer[np.ndarray, "h w"] | None:
    """Object ids of a mask file, None when it is missing or cannot be read."""
    try:
        return None if path is None else read_pixels(path)[..., 0]
    except InputError:
        return None


def fitted(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """The image at width, height of `size`, by areas when it shrinks."""
    if image.shape[1::-1] == size:
        return image
    shrinks = image.shape[1] > size[0]
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)


def jpeg(image: Float[np.ndarray, "h w 3"]) -> str:
    """A data URL."""
    pixels = np.rint(np.clip(image, 0, 1) * 255).astype(np.uint8)
    return _data_url(".jpg", "image/jpeg", pixels[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])


def webp(image: Float[np.ndarray, "h w 4"]) -> str:
    """A data URL of an image with straight alpha."""
    pixels = np.rint(np.clip(image, 0, 1) * 255).astype(np.uint8)
    return _data_url(".webp", "image/webp", pixels[..., [2, 1, 0, 3]], [cv2.IMWRITE_WEBP_QUALITY, _JPEG_QUALITY])


def difference(image: Float[np.ndarray, "h w 3"], other: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w 3"]:
    """Where two images differ: black equal, bright by `_SATURATED_DIFFERENCE` or more."""
    level = np.abs(image - other).mean(axis=-1) / _SATURATED_DIFFERENCE
    indices = np.rint(np.clip(level, 0, 1) * 255).astype(np.uint8)
    return cv2.applyColorMap(indices, cv2.COLORMAP_INFERNO)[..., ::-1].astype(np.float32) / 255


def overlay(ids: Integer[np.ndarray, "h w"], size: tuple[int, int]) -> str:
    """A transparent PNG that tints each object in its colour and draws its outline; a data URL."""
    ids = cv2.resize(ids.astype(np.uint16), size, interpolation=cv2.INTER_NEAREST)
    edges = np.zeros(ids.shape, bool)
    edges[:, 1:] |= ids[:, 1:] != ids[:, :-1]
    edges[1:] |= ids[1:] != ids[:-1]
    edges = cv2.dilate(edges.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
    painted: UInt8[np.ndarray, "h w 4"] = np.zeros((*ids.shape, 4), np.uint8)
    for identity in np.unique(ids[ids > 0]):
        painted[ids == identity] = (*color_of(int(identity))[::-1], 96)
    painted[edges & (ids > 0), 3] = 255
    return _data_url(".png", "image/png", painted, [])


def crop_box(ids: Integer[np.ndarray, "h w"], identity: int) -> tuple[int, int, int, int] | None:
    """Rows and columns (top, bottom, left, right) around an object with a margin; None where it is not."""
    rows, columns = np.nonzero(ids == identity)
    if rows.size == 0:
        return None
    margin = round(0.2 * max(np.ptp(rows), np.ptp(columns))) + 6
    top, bottom = max(0, rows.min() - margin), min(ids.shape[0], rows.max() + 1 + margin)
    left, right = max(0, columns.min() - margin), min(ids.shape[1], columns.max() + 1 + margin)
    return int(top), int(bottom), int(left), int(right)


def _data_url(suffix: str, kind: str, pixels: np.ndarray, options: list[int]) -> str:
    _, content = cv2.imencode(suffix, np.ascontiguousarray(pixels), options)
    return f"data:{kind};base64,{base64.b64encode(content.tobytes()).decode()}"
