"""FLIP against its closed form on flat images; LPIPS through a network of the user's own."""

import numpy as np
import pytest

from ltgs_jax.metrics import flip, flip_map, lpips


def _flip_of_flat(color: np.ndarray, other: np.ndarray) -> float:
    """LDR-FLIP of two flat sRGB images (Andersson et al. 2020, section 4): no edge, no point, no spatial filter."""

    def hunt_lab(srgb):
        srgb = np.asarray(srgb, np.float64)
        linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
        rows = [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.1191920, 0.9503041]]
        ratio = np.array(rows) @ linear / np.array(rows).sum(1)
        f = np.where(ratio > (6 / 29) ** 3, np.cbrt(ratio), ratio / (3 * (6 / 29) ** 2) + 4 / 29)
        lightness = 116 * f[1] - 16
        return np.array([lightness, 0.01 * lightness * 500 * (f[0] - f[1]), 0.01 * lightness * 200 * (f[1] - f[2])])

    def hyab(a, b):
        delta = hunt_lab(a) - hunt_lab(b)
        return (abs(delta[0]) + np.hypot(delta[1], delta[2])) ** 0.7

    most = hyab([0, 1, 0], [0, 0, 1])
    error, knee = hyab(color, other), 0.4 * most
    return 0.95 / knee * error if error < knee else 0.95 + (error - knee) / (most - knee) * 0.05


@pytest.mark.parametrize(
    "color, other", [((1, 1, 1), (0, 0, 0)), ((0.5, 0.5, 0.5), (0.45, 0.45, 0.45)), ((0.8, 0.3, 0.2), (0.7, 0.35, 0.3))]
)
def test_flip_of_flat_images(color, other):
    images = [np.broadcast_to(np.float32(value), (24, 24, 3)) for value in (color, other)]
    assert flip(*images) == pytest.approx(_flip_of_flat(*images[0][0, :1], *images[1][0, :1]), abs=2e-3)


def test_flip_is_zero_on_equal_images_and_counts_the_mask_only():
    rng = np.random.default_rng(0)
    image = rng.uniform(size=(32, 40, 3)).astype(np.float32)
    assert flip(image, image) == pytest.approx(0, abs=1e-6)
    other = image.copy()
    other[:, 20:] = 1 - other[:, 20:]
    mask = np.zeros((32, 40), bool)
    mask[:, :4] = True
    assert flip(image, other, mask) < 0.05 < flip(image, other)
    assert flip(image, other, mask) == pytest.approx(flip_map(image, other)[mask].mean())
    assert np.isnan(flip(image, other, np.zeros_like(mask)))
    with pytest.raises(ValueError, match="target"):
        flip(image, other[:10])


def test_lpips_says_which_file_is_wrong(tmp_path):
    pytest.importorskip("onnxruntime")
    image = np.zeros((8, 8, 3))
    (tmp_path / "weights.onnx").write_bytes(b"not a network")
    with pytest.raises(ValueError, match=r"weights\.onnx"):
        lpips(image, image, weights=tmp_path / "weights.onnx")
    with pytest.raises(ValueError, match=r"missing\.onnx"):
        lpips(image, image, weights=tmp_path / "missing.onnx")
    with pytest.raises(ValueError, match="target"):
        lpips(image, image[:4], weights=tmp_path / "weights.onnx")
