"""Camera models of COLMAP: intrinsics and lens distortion."""

import dataclasses
import math

import jax.numpy as jnp
import numpy as np

from ltgs_jax.geometry import SE3, Camera

from .files import InputError

PARAMETERS = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fx", "fy", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
}
"""Names of the parameters of each model that is read, in COLMAP's order."""

_LARGEST_SIDE = 1 << 17  # JPEG ends at 65 535; a wider size is a broken header, not a photograph


@dataclasses.dataclass(frozen=True)
class CameraModel:
    """Intrinsics and lens distortion: `model` and `params` in COLMAP's words and order, sizes in pixels."""

    model: str
    width: int
    height: int
    params: tuple[float, ...]

    def _named(self) -> dict[str, float]:
        return dict(zip(PARAMETERS[self.model], self.params, strict=True))

    def K(self) -> np.ndarray:
        """Pinhole matrix [3 3] float64 of the undistorted image: the model without its distortion."""
        p = self._named()
        fx, fy = p.get("fx", p.get("f")), p.get("fy", p.get("f"))
        return np.array([[fx, 0, p["cx"]], [0, fy, p["cy"]], [0, 0, 1]], dtype=np.float64)

    def distortion(self) -> np.ndarray:
        """k1, k2, p1, p2 as OpenCV orders them, [4] float64."""
        p = self._named()
        return np.array([p.get(name, 0.0) for name in ("k1", "k2", "p1", "p2")])

    def resized(self, width: int, height: int) -> "CameraModel":
        """The same lens for an image scaled to `width` × `height`."""
        sx, sy = width / self.width, height / self.height
        model, named = self.model, self._named()
        if "f" in named and not math.isclose(sx, sy):
            # One focal length cannot hold two scales; OPENCV holds every model that is read.
            f = named["f"]
            model, named = "OPENCV", {"fx": f, "fy": f, "k2": 0.0, "p1": 0.0, "p2": 0.0, "k1": 0.0, **named}
        scales = {"f": sx, "fx": sx, "fy": sy, "cx": sx, "cy": sy}
        params = tuple(named[name] * scales.get(name, 1.0) for name in PARAMETERS[model])
        return CameraModel(model, width, height, params)

    def camera(self, cam_from_world: SE3) -> Camera:
        """The pinhole camera of the undistorted photograph, in the dtype of the pose."""
        return Camera(cam_from_world, jnp.asarray(self.K(), cam_from_world.xyz.dtype), self.width, self.height)


def check_camera_model(model: str, width: int, height: int, params: tuple[float, ...], *, source: str) -> CameraModel:
    """A camera model from a file. Raises InputError that names `source` when it cannot be one."""
    if model not in PARAMETERS:
        known = ", ".join(PARAMETERS)
        raise InputError(f"{source}: camera model {model} is not read (only {known}); undistort the images first")
    names = PARAMETERS[model]
    if len(params) != len(names):
        raise InputError(f"{source}: {model} has {len(names)} parameters ({' '.join(names)}), got {len(params)}")
    if not (0 < width < _LARGEST_SIDE and 0 < height < _LARGEST_SIDE):
        raise InputError(f"{source}: a camera of {width}×{height} pixels")
    focal = [value for name, value in zip(names, params, strict=True) if name in ("f", "fx", "fy")]
    if not np.isfinite(params).all() or min(focal) <= 0:
        raise InputError(f"{source}: {model} with parameters {' '.join(f'{value:g}' for value in params)}")
    return CameraModel(model, width, height, tuple(float(value) for value in params))


def distort(lens: CameraModel, xy: np.ndarray) -> np.ndarray:
    """Distorted normalised coordinates [... 2] of ideal ones: COLMAP's OPENCV model, which holds the others."""
    k1, k2, p1, p2 = lens.distortion()
    x, y = xy[..., 0], xy[..., 1]
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * k2)
    u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    v = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return np.stack([u, v], axis=-1)


def _pixel_grid(width: int, height: int, K: np.ndarray) -> np.ndarray:
    """Normalised coordinates [h w 2] of the pixel centres."""
    x = (np.arange(width) + 0.5 - K[0, 2]) / K[0, 0]
    y = (np.arange(height) + 0.5 - K[1, 2]) / K[1, 1]
    return np.stack(np.broadcast_arrays(x[None, :], y[:, None]), axis=-1)


def is_pinhole(lens: CameraModel, K: np.ndarray) -> bool:
    """Whether the photograph already is what a pinhole camera with `K` would take, to 0.01 pixels."""
    corners = np.array([[0.0, 0.0], [lens.width, 0.0], [0.0, lens.height], [lens.width, lens.height]])
    ideal = (corners - K[:2, 2]) / np.diag(K)[:2]
    pixels = distort(lens, ideal) * np.diag(lens.K())[:2] + lens.K()[:2, 2]
    return bool(np.abs(pixels - corners).max() < 0.01)


def undistort_map(lens: CameraModel, K: np.ndarray) -> np.ndarray:
    """Where each pixel of the pinhole image with `K` lies in the photograph: [h w 2] float32, first pixel at 0.

    Points beyond the radius where the polynomial turns back are set outside, so that they end up masked.
    """
    ideal = _pixel_grid(lens.width, lens.height, K)
    source = distort(lens, ideal) * np.diag(lens.K())[:2] + lens.K()[:2, 2] - 0.5
    k1, k2, _, _ = lens.distortion()
    r2 = np.sum(ideal * ideal, axis=-1)
    folded = 1 + r2 * (3 * k1 + 5 * k2 * r2) <= 0
    source[folded] = -1e4
    return np.clip(source, -1e4, 1 << 18).astype(np.float32)


def distort_map(lens: CameraModel, K: np.ndarray) -> np.ndarray:
    """Where each pixel of the photograph lies in the pinhole image with `K`: [h w 2] float32, first pixel at 0.

    Fixed-point iteration, as OpenCV's: it contracts as far out as the lens is one that photographs are taken with;
    where it does not, the pixel is set outside.
    """
    distorted = _pixel_grid(lens.width, lens.height, lens.K())
    ideal = distorted.copy()
    for _ in range(50):
        ideal = np.clip(ideal + distorted - distort(lens, ideal), -1e3, 1e3)
    ideal[np.abs(distort(lens, ideal) - distorted).max(axis=-1) > 1e-4] = -1e6
    target = ideal * np.diag(K)[:2] + K[:2, 2] - 0.5
    return np.clip(target, -1e4, 1 << 18).astype(np.float32)
