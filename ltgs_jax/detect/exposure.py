"""What light, white balance and tone did between two visits, fitted robustly and taken out before comparing."""

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float

_POWERS = 3  # a cubic per channel follows exposure, contrast and gamma curves; the linear terms mix channels


class Tone(eqx.Module):
    """A colour mapping c ↦ features(c) @ `weights`, and whether it differs from the identity by more than noise."""

    weights: Float[np.ndarray, "f 3"]
    changed: bool

    def __call__(self, image: Float[np.ndarray, "*s 3"]) -> Float[np.ndarray, "*s 3"]:
        """The image as the other visit's light would show it, clipped to 0…1."""
        if not self.changed:
            return image
        return np.clip(_features(image) @ self.weights, 0, 1).astype(image.dtype)


def _features(colors: np.ndarray) -> np.ndarray:
    powers = [colors**p for p in range(1, _POWERS + 1)]
    return np.concatenate([np.ones_like(colors[..., :1]), *powers], axis=-1)


def _identity() -> np.ndarray:
    weights = np.zeros((1 + 3 * _POWERS, 3))
    weights[1:4] = np.eye(3)
    return weights


def fit_tone(
    rendered: Float[np.ndarray, "h w 3"],
    captured: Float[np.ndarray, "h w 3"],
    mask: Bool[np.ndarray, "h w"],
    *,
    gain_threshold: float = 0.03,
    iterations: int = 12,
) -> Tone:
    """The tone that takes `rendered` to `captured`, by iteratively reweighted ridge regression (Geman–McClure).

    Changed objects are outliers and lose their weight. Below a median correction of `gain_threshold` (in 0…1) light is
    taken as unchanged and the identity is returned: exposure is modelled only when the light changed.
    """
    usable = mask & (captured.min(axis=-1) > 0.01) & (captured.max(axis=-1) < 0.99)
    source, target = rendered[usable], captured[usable]
    if len(source) < 100:
        return Tone(_identity(), False)
    step = max(1, len(source) // 20_000)
    source, target = source[::step].astype(np.float64), target[::step].astype(np.float64)
    features = _features(source)
    ridge = 1e-3 * len(source) * np.eye(features.shape[1])
    weights = _identity()
    # A global gain first: the cubic's start must lie near enough for the outliers to show as outliers.
    gain = np.median(target, axis=0) / np.maximum(np.median(source, axis=0), 1e-3)
    weights[1:4] = np.diag(gain)
    for _ in range(iterations):
        residual = np.linalg.norm(features @ weights - target, axis=-1)
        scale = max(1.4826 * np.median(residual), 0.01)
        confidence = 1 / (1 + (residual / (2 * scale)) ** 2) ** 2
        normal = (features * confidence[:, None]).T @ features + ridge
        start = np.zeros_like(weights)
        start[1:4] = np.diag(gain)
        weights = np.linalg.solve(normal, (features * confidence[:, None]).T @ target + ridge @ start)
    correction = np.median(np.abs(features @ weights - source), axis=0)
    return Tone(weights, bool(correction.max() > gain_threshold))
