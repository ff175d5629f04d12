"""A photograph: what is known of it, its pixels as its pinhole camera sees them, labels laid back on it."""

import dataclasses
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float, Integer

from ltgs_jax.geometry import Camera

from .files import InputError
from .images import (
    alpha_of,
    as_rgb,
    lay_labels,
    read_header,
    read_pixels,
    resize_image,
    resize_mask,
    restore_orientation,
    scaled_size,
    undistort_image,
    undistort_mask,
)
from .lens import CameraModel


@dataclasses.dataclass(frozen=True)
class Photograph:
    """One photograph, named `<visit>/<file>`.

    `camera` is the pinhole camera of the undistorted photograph, None where the pose is not known (yet);
    `camera_model` the lens, `lens_given` whether a file says so (else it is that of the other photographs of this
    size; None when there is none). `role`: `train` or `test` at the first visit; `update`, `test`, or `unused` (in
    neither list) later. `width`, `height` in pixels, of the photograph as it is used. `oriented`: the EXIF
    orientation is applied, because only then the size agrees with the camera's. `exif_focal` in pixels, where the
    photograph's EXIF gives an equivalent focal length.
    """

    name: str
    visit: int
    path: Path
    camera: Camera | None
    role: str
    width: int
    height: int
    mask_path: Path | None
    camera_model: CameraModel | None
    lens_given: bool
    has_alpha: bool
    oriented: bool
    exif_focal: float | None = None


def load_image(photograph: Photograph, *, max_side: int | None = None) -> Float[np.ndarray, "h w 3"]:
    """The photograph as its pinhole camera sees it: float32 in 0..1, longer side at most `max_side` pixels.

    Undistorted by `camera_model` to the K of `camera` (that of the lens where there is no camera), then reduced by
    area; `camera.resized` to the image's size is its camera. Raises InputError that names the file.
    """
    image = as_rgb(_stored(photograph))
    image = undistort_image(image, photograph.camera_model, _pinhole(photograph))
    return resize_image(image, scaled_size(photograph.width, photograph.height, max_side))


def load_mask(photograph: Photograph, *, max_side: int | None = None) -> Bool[np.ndarray, "h w"]:
    """Which pixels of `load_image` count: False where the mask is 0, alpha under half, or no photograph lies.

    Raises InputError that names the file.
    """
    shape = (photograph.height, photograph.width)
    mask = np.ones(shape, dtype=bool)
    if photograph.has_alpha:
        mask &= alpha_of(_stored(photograph))
    if photograph.mask_path is not None:
        pixels = read_pixels(photograph.mask_path, oriented=photograph.oriented)
        if pixels.shape[:2] != shape:
            size = f"{pixels.shape[1]}×{pixels.shape[0]}"
            raise InputError(f"{photograph.mask_path}: is {size}, its photograph {shape[1]}×{shape[0]}")
        mask &= (pixels[..., :3] if pixels.shape[-1] >= 3 else pixels[..., :1]).any(axis=-1)
    mask = undistort_mask(mask, photograph.camera_model, _pinhole(photograph))
    return resize_mask(mask, scaled_size(photograph.width, photograph.height, max_side))


def distort_labels(labels: Integer[np.ndarray, "h w"], photograph: Photograph) -> Integer[np.ndarray, "h w"]:
    """Labels of the image that `load_image` gives, laid on the stored photograph, so that they fit the user's file.

    Labels of a reduced image are enlarged first; 0 where the pinhole image does not reach.
    """
    size = (photograph.width, photograph.height)
    if labels.shape[1::-1] != size:
        labels = cv2.resize(labels.astype(np.uint16), size, interpolation=cv2.INTER_NEAREST_EXACT)
    laid = lay_labels(labels, photograph.camera_model, _pinhole(photograph))
    if not photograph.oriented:
        return laid
    return restore_orientation(laid, read_header(photograph.path).orientation)


def _stored(photograph: Photograph) -> np.ndarray:
    pixels = read_pixels(photograph.path, oriented=photograph.oriented)
    if pixels.shape[:2] != (photograph.height, photograph.width):
        raise InputError(f"{photograph.path}: has changed its size since the capture was read")
    return pixels


def _pinhole(photograph: Photograph) -> np.ndarray | None:
    if photograph.camera is not None:
        return np.asarray(photograph.camera.K, dtype=np.float64)
    return None if photograph.camera_model is None else photograph.camera_model.K()
