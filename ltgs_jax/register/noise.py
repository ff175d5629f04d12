"""How large the noise is, where the bound was given too wide: the evidence of each level in the data."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.lax import Precision
from jaxtyping import Array, Float

from ltgs_jax.geometry import SE3

from .align import alignment_moments, squared_residuals
from .hypotheses import Problem, reweighted
from .outcome import RegisterConfig
from .refine import BOUND_IN_SIGMA, NEAR_WIDTHS, ResidualLaw, probability_within

# Shares of the bound that are weighed against each other, the bound itself first.
LEVELS = (1.0, 0.5, 0.25)
# Widths of what lies anywhere: up to the object's size and its surroundings, however small the noise, since a pose
# would else be drawn to outliers that no component reaches; finer at first, lest the near misses take them in.
_FAR_WIDTHS = (16.0, 32.0, 64.0, 128.0, 512.0, 2048.0, 8192.0)
# Widths of the residuals' components in units of the bound: exact pairs, near misses, and what lies anywhere.
_WIDTHS = (0.25, 0.5, *NEAR_WIDTHS, *_FAR_WIDTHS)
# Nats by which a narrower level must beat the given one, which the caller had a reason for.
_TRUST = 6.0
# The same in units of σ, for the law of the final fit.
_LAW_WIDTHS = (*NEAR_WIDTHS, *_FAR_WIDTHS)
_EM_STEPS = 30
# Shares are rounded to half octaves: a nuisance needs no more, and the optimum is a smooth function of the points.
_OCTAVES = 0.5


def _log_gaussian_norm(r: Float[Array, "..."], sigma: Float[Array, "..."]) -> Float[Array, "..."]:
    """Log density of the norm of three Gaussian coordinates (χ₃)."""
    half_log = 0.5 * jnp.log(jnp.asarray(2 / jnp.pi, r.dtype))
    return half_log + 2 * jnp.log(r) - 3 * jnp.log(sigma) - 0.5 * (r / sigma) ** 2


class _Mixture(eqx.Module):
    """Gaussians of known widths at their best shares, and what they make of each residual."""

    share: Float[Array, " k"]
    log_density: Float[Array, " n"]
    expected: Float[Array, " k"]


def _fit_mixture(
    norms: Float[Array, " n"], weights: Float[Array, " n"], sigmas: Float[Array, " k"], used: Float[Array, " k"]
) -> _Mixture:
    """Shares of the components `used` (1 or 0) by expectation and maximisation; all correspondences count.

    Those near one pose alone would not do: a pose through a few points must explain the rest too.
    """
    eps = jnp.finfo(norms.dtype).eps
    logs = _log_gaussian_norm(jnp.maximum(norms, eps * jnp.min(sigmas))[:, None], sigmas)
    logs = jnp.where(used > 0, logs, -jnp.inf)
    peak = jnp.max(logs, axis=1)
    density = jnp.exp(logs - peak[:, None])
    total = jnp.maximum(jnp.sum(weights), jnp.finfo(norms.dtype).tiny)

    def expected(share):
        # A row without weight may lie where no component with a share reaches.
        mixed = jnp.maximum(jnp.matmul(density, share, precision=Precision.HIGHEST), jnp.finfo(norms.dtype).tiny)
        return mixed, share * jnp.matmul(weights / mixed, density, precision=Precision.HIGHEST)

    share = jax.lax.fori_loop(0, _EM_STEPS, lambda _, share: expected(share)[1] / total, used / jnp.sum(used))
    mixed, counts = expected(share)
    return _Mixture(share, peak + jnp.log(mixed), counts)


def log_evidence(
    norms: Float[Array, " n"], weights: Float[Array, " n"], sigmas: Float[Array, " k"], used: Float[Array, " k"]
) -> Float[Array, ""]:
    """Log evidence of residual norms under a mixture of Gaussians of known widths, at its best shares.

    Σ w·log Σₖ pₖ·χ₃(r/σₖ) over the components `used` (1 or 0), and Laplace's room of the six fitted parameters: −½ log
    of their precision's determinant up to a constant, precision Σ w·P(k|r)/σₖ² to the power 6.
    """
    mixture = _fit_mixture(norms, weights, sigmas, used)
    return jnp.sum(weights * mixture.log_density) - 3 * jnp.log(jnp.sum(mixture.expected / sigmas**2))


def fit_law(whitened: Float[Array, "n 3"], weights: Float[Array, " n"]) -> ResidualLaw:
    """The law of residuals in units of σ: shares of exact pairs, near misses, and the height of the rest at 0."""
    widths = jnp.asarray(_LAW_WIDTHS, whitened.dtype)
    norms = jnp.sqrt(jnp.sum(whitened * whitened, axis=-1))
    share = _fit_mixture(norms, weights, widths, jnp.ones_like(widths)).share
    least = 1 / jnp.maximum(jnp.sum(weights), 1)
    rounded = jnp.exp2(_OCTAVES * jnp.round(jnp.log2(jnp.maximum(share, least)) / _OCTAVES))
    heights = jnp.where(share > least, rounded, 0).at[0].max(least) / widths**3
    near = len(NEAR_WIDTHS)
    return jax.lax.stop_gradient(ResidualLaw(heights[:near], jnp.sum(heights[near:])))


def narrow_bound(versions: SE3, problem: Problem, config: RegisterConfig) -> tuple[SE3, Float[Array, ""]]:
    """The motion, and the noise bound that the residuals speak for: the given one, a half or a quarter.

    `versions` [3] the best at each. A level's evidence knows no component narrower than the level. A bound that is too
    wide lets near misses in; one that is too narrow is not widened, since near misses would look the same.
    """
    moments = alignment_moments(problem.src, problem.dst)
    factors = jnp.asarray(LEVELS, problem.src.dtype)
    widths = jnp.asarray(_WIDTHS, problem.src.dtype)

    def step(_, motions):
        return reweighted(motions, problem, moments, lambda q: probability_within(q / factors[:, None] ** 2))

    motions = jax.lax.fori_loop(0, config.level_steps, step, versions)
    norms = jnp.sqrt(squared_residuals(motions.rotmat(), motions.xyz, problem.src, problem.dst))
    used = (widths >= factors[:, None]).astype(norms.dtype)
    sigmas = widths * problem.bound / BOUND_IN_SIGMA
    evidence = jax.vmap(lambda r, u: log_evidence(r, problem.weights, sigmas, u))(norms, used)
    best = jnp.argmax(evidence.at[0].add(_TRUST))
    return motions[best], problem.bound * factors[best]
