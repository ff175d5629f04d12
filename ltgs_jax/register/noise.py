"""How large the noise is, where the bound was given too wide: the evidence of each level in the data."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ltgs_jax.geometry import SE3

from .align import alignment_moments, squared_residuals
from .hypotheses import Problem, reweighted
from .outcome import RegisterConfig
from .refine import BOUND_IN_SIGMA, probability_within

# Shares of the bound that are weighed against each other, the bound itself first.
LEVELS = (1.0, 0.5, 0.25)
# Window of the comparison, in units of the given bound: beyond it every level sees outliers alone.
_WINDOW = 2.0
# Nats by which a narrower level must beat the given one, which the caller had a reason for.
_TRUST = 6.0
_EM_STEPS = 10


def _log_gaussian_norm(r: Float[Array, " n"], sigma: Float[Array, ""]) -> Float[Array, " n"]:
    """Log density of the norm of three Gaussian coordinates (χ₃)."""
    half_log = 0.5 * jnp.log(jnp.asarray(2 / jnp.pi, r.dtype))
    return half_log + 2 * jnp.log(r) - 3 * jnp.log(sigma) - 0.5 * (r / sigma) ** 2


def log_evidence(
    norms: Float[Array, " n"], weights: Float[Array, " n"], sigma: Float[Array, ""], window: Float[Array, ""]
) -> Float[Array, ""]:
    """Log evidence of noise σ in residual norms within a window, among outliers spread evenly over a surface.

    Σ w·log(p·χ₃(r/σ) + (1 − p)·2r/window²) at its best share p, and 6·log σ for the room of the six fitted parameters
    (Laplace). `weights` 0 outside the window.
    """
    r = jnp.clip(norms, jnp.finfo(norms.dtype).eps * window, window)
    inlier, outlier = _log_gaussian_norm(r, sigma), jnp.log(2 * r) - 2 * jnp.log(window)
    total = jnp.maximum(jnp.sum(weights), jnp.finfo(norms.dtype).tiny)

    def mixture(share):
        return jnp.logaddexp(jnp.log(share) + inlier, jnp.log1p(-share) + outlier)

    def step(_, share):
        posterior = jnp.exp(jnp.log(share) + inlier - mixture(share))
        return jnp.clip(jnp.sum(weights * posterior) / total, 0.01, 0.99)

    share = jax.lax.fori_loop(0, _EM_STEPS, step, jnp.asarray(0.5, norms.dtype))
    return jnp.sum(weights * mixture(share)) + 6 * jnp.log(sigma)


def narrow_bound(versions: SE3, problem: Problem, config: RegisterConfig) -> tuple[SE3, Float[Array, ""]]:
    """The motion, and the noise bound that the residuals speak for: the given one, a half or a quarter.

    `versions` [3] the best at each. A bound that is too wide lets near misses in; one that is too narrow is not
    widened, since near misses would look the same.
    """
    moments = alignment_moments(problem.src, problem.dst)
    factors = jnp.asarray(LEVELS, problem.src.dtype)
    bounds = problem.bound * factors

    def step(_, motions):
        return reweighted(motions, problem, moments, lambda q: probability_within(q / factors[:, None] ** 2))

    motions = jax.lax.fori_loop(0, config.level_steps, step, versions)
    norms = jnp.sqrt(squared_residuals(motions.rotmat(), motions.xyz, problem.src, problem.dst))
    window = _WINDOW * problem.bound
    seen = jnp.where(norms[0] < window, problem.weights, 0)
    evidence = jax.vmap(lambda r, bound: log_evidence(r, seen, bound / BOUND_IN_SIGMA, window))(norms, bounds)
    best = jnp.argmax(evidence.at[0].add(_TRUST))
    return motions[best], bounds[best]
