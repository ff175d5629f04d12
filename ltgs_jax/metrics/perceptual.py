"""Perceptual differences: FLIP by OpenImageIO, LPIPS by weights that the user brings."""

from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

_PIXELS_PER_DEGREE = 67.0206  # FLIP's own default: a 0.7 m wide 4K screen seen from 0.7 m


def flip(
    image: Float[np.ndarray, "h w 3"],
    target: Float[np.ndarray, "h w 3"],
    mask: Bool[np.ndarray, "h w"] | None = None,
) -> float:
    """Mean LDR-FLIP difference of two sRGB images in [0, 1]: 0 equal, 1 as different as can be.

    Andersson et al. 2020, at 67 pixels per degree. `mask` says which pixels count; an empty mask gives NaN.

    Raises ValueError when the shapes differ, ImportError without OpenImageIO.
    """
    error = flip_map(image, target)
    if mask is None:
        return float(error.mean())
    return float(error[np.asarray(mask, bool)].mean()) if np.any(mask) else float("nan")


def flip_map(image: Float[np.ndarray, "h w 3"], target: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w"]:
    """LDR-FLIP difference of every pixel of two sRGB images in [0, 1].

    Raises ValueError when the shapes differ, ImportError without OpenImageIO.
    """
    import OpenImageIO as oiio

    if np.shape(image) != np.shape(target) or np.ndim(image) != 3 or np.shape(image)[-1] != 3:
        raise ValueError(f"target: expected two images [h w 3], got {np.shape(image)} and {np.shape(target)}")
    buffers = []
    for pixels in (target, image):
        buffer = oiio.ImageBuf(np.ascontiguousarray(np.clip(pixels, 0, 1), np.float32))
        buffer.specmod().attribute("oiio:ColorSpace", "srgb_rec709_scene")
        buffers.append(buffer)
    error = oiio.ImageBufAlgo.FLIP_diff(*buffers, hdr=0, ppd=_PIXELS_PER_DEGREE)
    if error.has_error:
        raise ValueError(f"image: FLIP cannot be taken ({error.geterror().strip()})")
    return np.asarray(error.get_pixels(oiio.FLOAT))[..., 0]


def lpips(image: Float[np.ndarray, "h w 3"], target: Float[np.ndarray, "h w 3"], *, weights: str | Path) -> float:
    """Learned perceptual distance of two images in [0, 1], by the network in the ONNX file `weights`.

    The network takes two batches [1 3 h w] in [−1, 1] and gives the distance, as a scalar or as a map that is averaged
    (Zhang et al. 2018). No weights come with this package.

    Raises ValueError when the shapes differ or the file is no such network, ImportError without onnxruntime.
    """
    import onnxruntime

    if np.shape(image) != np.shape(target):
        raise ValueError(f"target: expected the image's shape {np.shape(image)}, got {np.shape(target)}")
    try:
        session = onnxruntime.InferenceSession(str(weights), providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime's exceptions have no public common class
        raise ValueError(f"{weights}: is not an ONNX network ({str(error).splitlines()[0]})") from error
    names = [entry.name for entry in session.get_inputs()]
    if len(names) != 2:
        raise ValueError(f"{weights}: expected a network of two images, got {len(names)} inputs")
    batches = [np.moveaxis(np.asarray(pixels, np.float32) * 2 - 1, -1, 0)[None] for pixels in (image, target)]
    distance = session.run(None, dict(zip(names, batches, strict=True)))[0]
    return float(np.mean(np.asarray(distance)))
