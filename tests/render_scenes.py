"""Small scenes for the renderer's tests."""

import jax.numpy as jnp
import numpy as np

from ltgs_jax.geometry import SE3, Camera
from ltgs_jax.scene import Splats


def make_camera(width=45, height=37, dtype=jnp.float64, seed=0) -> Camera:
    """A camera near the origin that looks along +z, slightly turned, principal point off centre."""
    rng = np.random.default_rng(seed)
    tangent = jnp.asarray(0.05 * rng.standard_normal(6), dtype)
    focal = 0.9 * max(width, height)
    K = jnp.asarray([[focal, 0, 0.5 * width + 1.3], [0, 1.1 * focal, 0.5 * height - 0.7], [0, 0, 1]], dtype)
    return Camera(SE3.exp(tangent), K, width, height)


def make_splats(n=60, dtype=jnp.float64, seed=0, degree=3, scale=0.1, logit=0.5) -> Splats:
    """Splats of random shape in front of `make_camera`."""
    rng = np.random.default_rng(seed)
    z = rng.uniform(2, 5, n)
    xy = rng.uniform(-0.55, 0.55, (n, 2)) * z[:, None]
    sh = 0.3 * rng.standard_normal((n, (degree + 1) ** 2, 3))
    sh[:, 0] += 1.0
    return Splats(
        means=jnp.asarray(np.concatenate([xy, z[:, None]], axis=1), dtype),
        quats=jnp.asarray(rng.standard_normal((n, 4)), dtype),
        log_scales=jnp.asarray(np.log(scale) + 0.6 * rng.standard_normal((n, 3)), dtype),
        logit_opacities=jnp.asarray(logit + 1.5 * rng.standard_normal(n), dtype),
        sh=jnp.asarray(sh, dtype),
    )
