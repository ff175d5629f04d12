"""Photographs, masks and label images on disk, and the way between a photograph and its pinhole image."""

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import OpenImageIO as oiio
from jaxtyping import Bool, Float, Integer

from .files import InputError, replacing
from .lens import CameraModel, distort_map, is_pinhole, undistort_map

SUFFIXES = (".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp", ".ppm")
_MOST_PIXELS = 1 << 28  # 268 megapixels: beyond any camera; a header that claims more is not believed
_MOST_PIXELS_PER_BYTE = 4000  # an empty mask as PNG reaches 1000; beyond this the header is not believed
_LARGE_PIXELS = 1 << 25  # beyond 33 megapixels, where it costs memory, a picture must be one
_MOST_PIXELS_PER_BYTE_LARGE = 50  # a plain wall as JPEG reaches 30


@dataclasses.dataclass(frozen=True)
class ImageHeader:
    """Stored size in pixels, channels, the EXIF orientation (1 = as stored), and the focal length in pixels by EXIF."""

    width: int
    height: int
    channels: int
    orientation: int
    focal: float | None


def read_header(path: Path) -> ImageHeader:
    """Size and channels of an image without decoding it, and that its end is there.

    Raises InputError that names the file when it is no image or is cut short.
    """
    if path.suffix.lower() in (".heic", ".heif"):
        raise InputError(f"{path}: HEIC is not read; convert it first, e.g. with `heif-convert {path.name} photo.jpg`")
    if not path.is_file():
        raise InputError(f"{path}: no such photograph")
    if path.stat().st_size == 0:
        raise InputError(f"{path}: is empty")
    # Before the decoder sees it: libpng complains on stderr of its own accord.
    if _is_cut_short(path):
        raise InputError(f"{path}: is cut short")
    image = oiio.ImageInput.open(str(path))
    if image is None:
        raise InputError(f"{path}: is not an image that can be read ({_last_error()})")
    spec = image.spec()
    image.close()
    width, height = spec.width, spec.height
    size = path.stat().st_size
    per_byte = _MOST_PIXELS_PER_BYTE if width * height <= _LARGE_PIXELS else _MOST_PIXELS_PER_BYTE_LARGE
    if not (width > 0 and height > 0 and width * height <= min(_MOST_PIXELS, per_byte * size)):
        raise InputError(f"{path}: its header claims {width}×{height} pixels in {size} bytes")
    # Equivalent focal lengths refer to film 36 mm wide.
    equivalent = spec.get_float_attribute("Exif:FocalLengthIn35mmFilm", 0.0)
    focal = equivalent / 36 * max(width, height) if 5 <= equivalent <= 1000 else None
    return ImageHeader(width, height, spec.nchannels, spec.get_int_attribute("Orientation", 1), focal)


def _last_error() -> str:
    lines = oiio.geterror().strip().splitlines()
    return lines[-1] if lines else "unknown format"


def _is_cut_short(path: Path) -> bool:
    """Whether a JPEG or PNG lacks its end marker; phones append data behind it, so it need not come last."""
    with path.open("rb") as file:
        magic = file.read(8)
        marker = {b"\xff\xd8\xff": b"\xff\xd9", b"\x89PN": b"IEND"}.get(magic[:3])
        if marker is None:
            return False
        size = file.seek(0, 2)
        file.seek(max(0, size - 65536))
        if marker in file.read():
            return False
        file.seek(0)
        content = file.read()
    if marker == b"IEND":
        return marker not in content
    # A thumbnail in the EXIF block has an end of its own, before the last start of a scan.
    return content.rfind(marker) <= content.rfind(b"\xff\xda")


def read_pixels(path: Path, *, oriented: bool = False) -> np.ndarray:
    """Stored pixels [h w c] in the file's own type, straight alpha; `oriented` applies the EXIF orientation.

    Raises InputError that names the file.
    """
    read_header(path)
    config = oiio.ImageSpec()
    config.attribute("oiio:UnassociatedAlpha", 1)
    image = oiio.ImageInput.open(str(path), config)
    pixels = None if image is None else image.read_image(image.spec().format)
    message = _last_error() if image is None else (image.geterror().strip().splitlines() or [""])[-1]
    orientation = 1 if image is None else image.spec().get_int_attribute("Orientation", 1)
    if image is not None:
        image.close()
    if pixels is None or message:
        raise InputError(f"{path}: cannot be decoded ({message or 'unknown reason'})")
    pixels = np.asarray(pixels)
    if pixels.ndim == 2:
        pixels = pixels[..., None]
    return _orient(pixels, orientation) if oriented else pixels


def _orient(pixels: np.ndarray, orientation: int) -> np.ndarray:
    """The image the right way up by EXIF tag 274."""
    if orientation in (5, 6, 7, 8):
        pixels = pixels.swapaxes(0, 1)
    if orientation in (2, 3, 6, 7):
        pixels = pixels[:, ::-1]
    if orientation in (3, 4, 7, 8):
        pixels = pixels[::-1]
    return np.ascontiguousarray(pixels)


def restore_orientation(image: np.ndarray, orientation: int) -> np.ndarray:
    """The inverse of the EXIF orientation: from the right way up to as stored."""
    inverse = {6: 8, 8: 6}
    return _orient(image, inverse.get(orientation, orientation))


def as_rgb(pixels: np.ndarray) -> Float[np.ndarray, "h w 3"]:
    """RGB float32 in 0..1 of stored pixels: 8 or 16 bit or float; grey or colour, with alpha or without."""
    colors = pixels[..., :1].repeat(3, axis=-1) if pixels.shape[-1] in (1, 2) else pixels[..., :3]
    if np.issubdtype(colors.dtype, np.integer):
        return colors.astype(np.float32) / np.float32(np.iinfo(colors.dtype).max)
    return np.clip(np.nan_to_num(colors), 0, 1).astype(np.float32)


def alpha_of(pixels: np.ndarray) -> Bool[np.ndarray, "h w"] | None:
    """Where the alpha channel says that there is something, by half; None without alpha."""
    if pixels.shape[-1] not in (2, 4):
        return None
    alpha = pixels[..., -1]
    return alpha > (np.iinfo(alpha.dtype).max // 2 if np.issubdtype(alpha.dtype, np.integer) else 0.5)


def undistort_image(image: np.ndarray, lens: CameraModel | None, K: np.ndarray | None) -> np.ndarray:
    """The image [h w c] as a pinhole camera with `K` takes it; pixels outside the photograph become 0."""
    if lens is None or K is None or is_pinhole(lens, K):
        return image
    x, y = np.moveaxis(undistort_map(lens, K), -1, 0)
    return cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def undistort_mask(mask: Bool[np.ndarray, "h w"], lens: CameraModel | None, K: np.ndarray | None) -> np.ndarray:
    """The mask [h w] of the pinhole image: False outside the photograph too."""
    if lens is None or K is None or is_pinhole(lens, K):
        return mask
    x, y = np.moveaxis(undistort_map(lens, K), -1, 0)
    near = cv2.remap(mask.astype(np.uint8), x, y, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT)
    half = 0.5
    inside = (x >= -half) & (x <= lens.width - half) & (y >= -half) & (y <= lens.height - half)
    return (near > 0) & inside


def lay_labels(
    labels: Integer[np.ndarray, "h w"], lens: CameraModel | None, K: np.ndarray | None
) -> Integer[np.ndarray, "h w"]:
    """Labels of the pinhole image with `K`, laid on the distorted photograph of `lens`; 0 outside."""
    if lens is None or K is None or is_pinhole(lens, K):
        return labels
    x, y = np.moveaxis(distort_map(lens, K), -1, 0)
    return cv2.remap(labels.astype(np.uint16), x, y, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT)


def scaled_size(width: int, height: int, max_side: int | None) -> tuple[int, int]:
    """Width and height with the longer side at most `max_side`; never enlarged."""
    if max_side is None or max(width, height) <= max_side:
        return width, height
    scale = max_side / max(width, height)
    return max(1, round(width * scale)), max(1, round(height * scale))


def resize_image(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """The image reduced to width, height of `size` by averaging areas."""
    if image.shape[1::-1] == size:
        return image
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA)


def resize_mask(mask: Bool[np.ndarray, "h w"], size: tuple[int, int]) -> Bool[np.ndarray, "h w"]:
    """The mask reduced to width, height of `size`: a pixel counts when all that it covers counts."""
    if mask.shape[1::-1] == size:
        return mask
    return cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.999


def write_image(path: str | Path, image: Float[np.ndarray, "h w 3"] | Float[np.ndarray, "h w"]) -> None:
    """Write an image in 0..1 with 8 bits, by the suffix, in one step. Raises InputError."""
    pixels = np.rint(np.clip(np.nan_to_num(np.asarray(image)), 0, 1) * 255).astype(np.uint8)
    write_pixels(Path(path), pixels)


def _label_dtype(labels: np.ndarray) -> type:
    return np.uint8 if labels.size == 0 or labels.max() < 256 else np.uint16


def write_labels(path: str | Path, labels: Integer[np.ndarray, "h w"]) -> None:
    """Write object ids as a grey PNG, 8 bit where they fit, else 16 bit. Raises ValueError beyond that, InputError."""
    labels = np.asarray(labels)
    if labels.size and not 0 <= labels.min() <= labels.max() < 1 << 16:
        raise ValueError(f"labels: expected ids from 0 to 65535, got {labels.min()} to {labels.max()}")
    write_pixels(Path(path), labels.astype(_label_dtype(labels)))


def read_labels(path: str | Path) -> Integer[np.ndarray, "h w"]:
    """Object ids of a grey PNG of 8 or 16 bits. Raises InputError that names the file."""
    return read_pixels(Path(path))[..., 0]


def write_pixels(path: Path, pixels: np.ndarray) -> None:
    """Write pixels [h w] or [h w c] in their own type, by the suffix, in one step. Raises InputError."""
    if pixels.ndim == 2:
        pixels = pixels[..., None]
    with replacing(path) as beside:
        spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], pixels.shape[2], str(pixels.dtype))
        output = oiio.ImageOutput.create(str(beside))
        if output is None:
            raise InputError(f"{path}: images of type {path.suffix or 'without suffix'} are not written")
        if not (output.open(str(beside), spec) and output.write_image(np.ascontiguousarray(pixels)) and output.close()):
            raise InputError(f"{path}: cannot be written ({output.geterror().strip()})")
