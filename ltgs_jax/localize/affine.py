"""Keypoints of simulated oblique views (ASIFT, Morel & Yu 2009), for photographs from another side of a table."""

import cv2
import numpy as np
from jaxtyping import Float

from ltgs_jax.features import root_sift

Keypoints = tuple[Float[np.ndarray, "m 2"], Float[np.ndarray, "m d"]]
_BORDER_PX = 3.0  # keypoints nearer to the photograph's edge see the padding


def _tilted(
    image: Float[np.ndarray, "h w 3"], *, tilt: float, turn: float
) -> tuple[Float[np.ndarray, "h2 w2 3"], Float[np.ndarray, "2 3"]]:
    """The image turned by `turn` rad and shortened by `tilt` along x, and the map from its pixels to the view's."""
    height, width = image.shape[:2]
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    corners = np.array([[0, 0], [width, 0], [0, height], [width, height]]) @ rotation.T
    low, high = corners.min(axis=0), corners.max(axis=0)
    view_from_image = np.concatenate([rotation, -low[:, None]], axis=1)
    on_indices = view_from_image.copy()
    on_indices[:, 2] += rotation @ [0.5, 0.5] - 0.5  # OpenCV counts from the first pixel's centre
    size = tuple(int(np.ceil(extent)) for extent in high - low)
    turned = cv2.warpAffine(image, on_indices, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    blurred = cv2.GaussianBlur(turned, (0, 0), sigmaX=0.8 * np.sqrt(tilt**2 - 1), sigmaY=0.01)
    short = max(1, round(size[0] / tilt))
    view_from_image[0] *= short / size[0]
    return cv2.resize(blurred, (short, size[1]), interpolation=cv2.INTER_LINEAR), view_from_image


def affine_keypoints(image: Float[np.ndarray, "h w 3"], *, tilts: tuple[float, ...], contrast: float) -> Keypoints:
    """RootSIFT keypoints of the image and of its views at each tilt, every 72°/tilt, all in the image's pixels.

    `tilts` > 1 (empty: the image alone); `contrast` SIFT's threshold.
    """
    height, width = image.shape[:2]
    found = [root_sift(image, contrast=contrast)]
    for tilt in tilts:
        for turn in np.deg2rad(np.arange(0, 180, 72 / tilt)):
            view, view_from_image = _tilted(image, tilt=tilt, turn=float(turn))
            xy, descriptors = root_sift(view, contrast=contrast)
            back = (xy - view_from_image[:, 2]) @ np.linalg.inv(view_from_image[:, :2]).T
            inner = np.all((back > _BORDER_PX) & (back < np.array([width, height]) - _BORDER_PX), axis=1)
            found.append((back[inner].astype(np.float32), descriptors[inner]))
    return np.concatenate([xy for xy, _ in found]), np.concatenate([descriptors for _, descriptors in found])
