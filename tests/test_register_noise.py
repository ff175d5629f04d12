"""The law of residuals and the normal equations against automatic differentiation and made-up mixtures."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from register_problems import angle, motion, surface

from ltgs_jax.geometry import SE3
from ltgs_jax.register import register
from ltgs_jax.register.hypotheses import Problem
from ltgs_jax.register.noise import fit_law
from ltgs_jax.register.refine import (
    BOUND_IN_SIGMA,
    NEAR_WIDTHS,
    ResidualLaw,
    isotropic_whitener,
    normal_equations,
    robust_residuals,
    whitened_residuals,
)


def made_up_law() -> ResidualLaw:
    return ResidualLaw(jnp.asarray([0.5, 0.0, 0.02, 0.001]), jnp.asarray(1e-6))


def test_trust_is_the_derivative_of_the_loss():
    law = made_up_law()
    squared = jnp.asarray([1e-3, 0.5, 4.0, 20.0, 200.0])
    np.testing.assert_allclose(jax.vmap(jax.grad(law.loss))(squared), law.trust(squared), rtol=1e-3, atol=1e-7)


def test_squares_of_robust_residuals_are_the_loss():
    law = made_up_law()
    whitened = jnp.asarray([[0.0, 0.0, 0.0], [0.3, -0.2, 0.1], [4.0, 3.0, 0.0], [100.0, 0.0, 0.0]])
    expected = law.loss(jnp.sum(whitened**2, axis=1))
    np.testing.assert_allclose(jnp.sum(robust_residuals(whitened, law) ** 2, axis=1), expected, rtol=1e-5)
    assert np.isfinite(jax.jacobian(lambda x: robust_residuals(x, law))(whitened)).all()


def test_before_anything_is_known_odds_are_even_at_the_bound():
    law = ResidualLaw.of_bound(jnp.float32)
    np.testing.assert_allclose(law.trust(jnp.asarray([0.0, BOUND_IN_SIGMA**2])), [1, 0.5], atol=5e-3)


def test_the_law_finds_the_shares_of_a_mixture():
    """200 exact pairs, 400 near misses eight times as wide, 400 anywhere: heights at 0 are shares over widths cubed."""
    rng = np.random.default_rng(0)
    whitened = rng.normal(size=(1000, 3)) * np.repeat([1.0, 8.0, 64.0], [200, 400, 400])[:, None]
    law = fit_law(jnp.asarray(whitened, jnp.float32), jnp.ones(1000))
    share = np.asarray(law.near) * np.asarray(NEAR_WIDTHS) ** 3
    # Rounded to half octaves, and 30 points of expectation and maximisation leave something between the widths.
    assert 0.15 < share[:2].sum() < 0.26
    assert 0.28 < share[2:].sum() < 0.55
    assert float(law.flat) < 1e-4


@pytest.mark.parametrize("isotropic", [True, False])
def test_normal_equations_are_those_of_automatic_differentiation(isotropic):
    with jax.enable_x64(True):
        rng = np.random.default_rng(1)
        src, dst = (jnp.asarray(rng.normal(size=(12, 3))) for _ in range(2))
        problem = Problem(src, dst, jnp.ones(12), jnp.asarray(0.7))
        pose = SE3.exp(jnp.asarray(rng.normal(size=6)))
        trust = jnp.asarray(rng.uniform(size=12))
        whitener = isotropic_whitener(problem) if isotropic else jnp.asarray(rng.normal(size=(12, 3, 3)))

        def residuals(tangent):
            return whitened_residuals(pose @ SE3.exp(tangent), problem, whitener)

        jacobian, at = jax.jacfwd(residuals)(jnp.zeros(6)), residuals(jnp.zeros(6))
        normal, gradient = normal_equations(pose, problem, whitener, trust)
        np.testing.assert_allclose(normal, jnp.einsum("n,nij,nik->jk", trust, jacobian, jacobian), atol=1e-9)
        np.testing.assert_allclose(gradient, jnp.einsum("n,nij,ni->j", trust, jacobian, at), atol=1e-9)


@pytest.mark.parametrize("factor", [1.0, 4.0])
def test_near_misses_do_not_pull_the_answer_from_the_exact_pairs(factor):
    """Of 120, 24 exact pairs, 60 that slid by 5 to 20 σ along the surface, the rest anywhere."""
    wrong = []
    for seed in range(6):
        rng = np.random.default_rng(300 + seed)
        src = surface(rng, 120)
        rotmat, xyz = motion(rng)
        slid = src.copy()
        away = rng.normal(size=(60, 3))
        away /= np.linalg.norm(away, axis=1, keepdims=True)
        slid[24:84] += away * rng.uniform(0.025, 0.1, (60, 1))
        slid[84:] = rng.permutation(src)[:36]
        dst = slid @ rotmat.T + xyz + 0.005 * rng.normal(size=src.shape)
        wrong.append(angle(register(src, dst, noise_bound=0.017 * factor).dst_from_src, rotmat))
    assert np.median(wrong) < 1.5
    assert max(wrong) < 5
