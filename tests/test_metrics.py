"""PSNR and SSIM against scikit-image, central differences and closed forms."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from skimage.metrics import structural_similarity

from ltgs_jax.metrics import SSIM_RADIUS, psnr, ssim, ssim_map


def _pair(seed: int, shape: tuple[int, ...] = (40, 52, 3)) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    image = rng.uniform(size=shape)
    return image, np.clip(image + 0.1 * rng.normal(size=shape), 0, 1)


def _reference_ssim(image: np.ndarray, target: np.ndarray) -> np.ndarray:
    options = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "full": True}
    return structural_similarity(image, target, data_range=1.0, channel_axis=-1, **options)[1]


def test_psnr_of_a_constant_error():
    target = jnp.full((16, 16, 3), 0.5)
    np.testing.assert_allclose(psnr(target + 0.1, target), 20, rtol=1e-5)
    assert psnr(target, target) == jnp.inf


def test_psnr_counts_masked_pixels_only():
    target = jnp.full((16, 16, 3), 0.5)
    mask = jnp.zeros((16, 16), bool).at[:4].set(True)
    image = jnp.where(mask[..., None], target + 0.01, target + 0.4)
    np.testing.assert_allclose(psnr(image, target, mask), 40, rtol=1e-4)
    np.testing.assert_allclose(psnr(image, target, mask.astype(jnp.float32)), 40, rtol=1e-4)
    assert jnp.isnan(psnr(image, target, jnp.zeros_like(mask)))


@pytest.mark.parametrize("dtype, atol", [(np.float64, 1e-12), (np.float32, 3e-5)])
def test_ssim_agrees_with_scikit_image(dtype, atol):
    image, target = _pair(0)
    reference = _reference_ssim(image, target)
    inside = (slice(SSIM_RADIUS, -SSIM_RADIUS),) * 2
    with jax.enable_x64(dtype == np.float64):
        ours = ssim_map(jnp.asarray(image, dtype), jnp.asarray(target, dtype))
        assert ours.dtype == dtype
        np.testing.assert_allclose(ours[inside], reference[inside], atol=atol)
        mean = ssim(jnp.asarray(image, dtype), jnp.asarray(target, dtype))
        np.testing.assert_allclose(mean, reference[inside].mean(), atol=atol)


def test_masked_ssim_is_the_mean_of_the_map_under_the_mask():
    image, target = _pair(1)
    mask = np.random.default_rng(2).uniform(size=image.shape[:2]) > 0.7
    inside = (slice(SSIM_RADIUS, -SSIM_RADIUS),) * 2
    expected = _reference_ssim(image, target)[inside][mask[inside]].mean()
    np.testing.assert_allclose(ssim(jnp.asarray(image), jnp.asarray(target), jnp.asarray(mask)), expected, atol=1e-5)


def test_a_batch_is_its_images():
    image, target = _pair(3, (2, 20, 24, 3))
    image, target = jnp.asarray(image), jnp.asarray(target)
    np.testing.assert_allclose(ssim(image, target), jax.vmap(ssim)(image, target), rtol=1e-6)
    np.testing.assert_allclose(psnr(image, target), [psnr(image[i], target[i]) for i in range(2)], rtol=1e-6)


@pytest.mark.parametrize("level", [0.0, 0.9371, 1.0])
def test_flat_windows_stay_in_range_in_float32(level):
    """E[x²] − E[x]² rounds below zero on bright flat windows."""
    flat = jnp.full((32, 32, 3), level, jnp.float32)
    noisy = flat.at[16, 16].add(-1e-4)
    value, gradient = jax.value_and_grad(lambda x: ssim(x, flat))(noisy)
    assert 0.999 < value <= 1 + 1e-4
    assert jnp.isfinite(gradient).all()
    assert (ssim_map(flat, flat) <= 1 + 1e-4).all()


def test_ssim_error_in_float32_stays_small_on_photograph_like_images():
    """Smooth bright gradients with faint texture, where the variance is a difference of near equals."""
    rows, columns = np.mgrid[:64, :64] / 64
    image = np.stack([0.8 + 0.1 * rows, 0.9 - 0.05 * columns, 0.85 + 0 * rows], -1)
    image = image + 0.004 * np.random.default_rng(5).normal(size=image.shape)
    target = image + 0.004 * np.random.default_rng(6).normal(size=image.shape)
    inside = (slice(SSIM_RADIUS, -SSIM_RADIUS),) * 2
    error = np.abs(ssim_map(jnp.float32(image), jnp.float32(target)) - _reference_ssim(image, target))[inside]
    assert error.max() < 2e-3 and error.mean() < 2e-4


@pytest.mark.parametrize("argument", [0, 1])
def test_gradient_agrees_with_central_differences(argument):
    image, target = _pair(4, (18, 17, 2))
    weights = np.random.default_rng(7).normal(size=image.shape)
    with jax.enable_x64(True):
        pair = [jnp.asarray(image), jnp.asarray(target)]

        def loss(x):
            return jnp.sum(ssim_map(*[x if i == argument else other for i, other in enumerate(pair)]) * weights)

        gradient = jax.grad(loss)(pair[argument])
        step = 1e-6
        for index in [(0, 0, 0), (9, 8, 1), (17, 16, 0), (5, 12, 1), (2, 15, 0)]:
            basis = jnp.zeros(image.shape).at[index].set(step)
            numeric = (loss(pair[argument] + basis) - loss(pair[argument] - basis)) / (2 * step)
            np.testing.assert_allclose(gradient[index], numeric, rtol=1e-6, atol=1e-8)


def test_gradient_descent_on_dssim_recovers_the_target():
    image, target = _pair(8, (24, 24, 3))
    image, target = jnp.asarray(image, jnp.float32), jnp.asarray(target, jnp.float32)
    step = jax.jit(lambda x: x - 20 * jax.grad(lambda y: 1 - ssim(y, target))(x))
    before = ssim(image, target)
    for _ in range(100):
        image = step(image)
    assert 1 - ssim(image, target) < 0.2 * (1 - before)


def test_wrong_shapes_are_named():
    image = jnp.zeros((16, 16, 3))
    with pytest.raises(ValueError, match="target"):
        psnr(image, image[:8])
    with pytest.raises(ValueError, match="mask"):
        ssim(image, image, jnp.zeros((8, 8), bool))
    with pytest.raises(ValueError, match="11 × 11"):
        ssim(image[:10], image[:10])


def test_no_warning_on_equal_images():
    image = jnp.asarray(_pair(9)[0])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        np.testing.assert_allclose(ssim(image, image), 1, atol=1e-6)


def test_a_nan_is_not_hidden():
    image = jnp.asarray(_pair(10)[0])
    assert jnp.isnan(ssim(image.at[0, 0, 0].set(jnp.nan), image))
    assert jnp.isnan(ssim(image.at[20, 20, 1].set(jnp.nan), image))
