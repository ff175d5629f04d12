"""Final robust least squares on the tangent of SE(3), with optimistix, and what it says about the answer."""

import jax
import jax.numpy as jnp
import lineax as lx
import optimistix as optx
from jax.lax import Precision
from jaxtyping import Array, Bool, Float

from ltgs_jax.geometry import SE3

from .hypotheses import Problem
from .outcome import RegisterConfig

# 99 % of the residuals of three Gaussian coordinates lie under 3.37 σ: √(χ²₃ at 0.99).
BOUND_IN_SIGMA = 3.3682


def robust_residuals(whitened: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    """Residuals whose squares sum to −2·log likelihood of an inlier Gaussian with a constant share of outliers.

    `whitened` in units of σ. The share is such that a residual at the noise bound is an inlier with odds of one: a
    smooth truncated least squares, ρ = −2·log((exp(−m²/2) + c)/(1 + c)).
    """
    squared = jnp.sum(whitened * whitened, axis=-1)
    outlier = jnp.exp(jnp.asarray(-0.5 * BOUND_IN_SIGMA**2, squared.dtype))
    positive = squared > 0
    safe = jnp.where(positive, squared, 1)
    rho = -2 * jnp.log1p(jnp.expm1(-0.5 * safe) / (1 + outlier))
    factor = jnp.where(positive, jnp.sqrt(rho / safe), jax.lax.rsqrt(1 + outlier))
    return factor[:, None] * whitened


def probability_within(relative: Float[Array, "..."]) -> Float[Array, "..."]:
    """Weight of r²/bound² in the robust fit: its odds against the constant share of outliers."""
    return jax.nn.sigmoid(0.5 * BOUND_IN_SIGMA**2 * (1 - relative))


def inlier_probability(whitened: Float[Array, "n 3"]) -> Float[Array, " n"]:
    """Weight of each residual, in units of σ, in the robust fit."""
    return probability_within(jnp.sum(whitened * whitened, axis=-1) / BOUND_IN_SIGMA**2)


def whitened_residuals(motion: SE3, problem: Problem, whitener: Float[Array, "n 3 3"]) -> Float[Array, "n 3"]:
    """Residuals in units of their standard deviation."""
    residuals = motion.apply(problem.src) - problem.dst
    return jnp.einsum("nij,nj->ni", whitener, residuals, precision=Precision.HIGHEST)


def isotropic_whitener(problem: Problem) -> Float[Array, "n 3 3"]:
    """Whitener of equal noise in all directions, whose 99 % bound is the noise bound."""
    eye = jnp.eye(3, dtype=problem.src.dtype) * (BOUND_IN_SIGMA / problem.bound)
    return jnp.broadcast_to(eye, (*problem.weights.shape, 3, 3))


def approach(start: SE3, problem: Problem, whitener: Float[Array, "n 3 3"], steps: int) -> SE3:
    """Reweighted Gauss-Newton steps in closed 6×6 form: cheap, and precise where a cost is rounded away."""
    weights = problem.weights

    def step(_, motion):
        whitened = whitened_residuals(motion, problem, whitener)
        jacobian = tangent_jacobian(motion, problem, whitener)
        trust = weights * inlier_probability(whitened)
        normal = jnp.einsum("n,nij,nik->jk", trust, jacobian, jacobian, precision=Precision.HIGHEST)
        gradient = jnp.einsum("n,nij,ni->j", trust, jacobian, whitened, precision=Precision.HIGHEST)
        # Keeps a direction that no point fixes where it is.
        ridge = jnp.finfo(normal.dtype).eps * (1 + jnp.trace(normal))
        return motion @ SE3.exp(-jnp.linalg.solve(normal + ridge * jnp.eye(6, dtype=normal.dtype), gradient))

    return jax.lax.fori_loop(0, steps, step, start)


def final_solve(
    start: SE3, problem: Problem, whitener: Float[Array, "n 3 3"], config: RegisterConfig
) -> tuple[SE3, Bool[Array, ""]]:
    """The robust optimum near `start`, and whether the solver got there.

    The unknown is the tangent in units of σ, so that tolerances mean shares of the noise. Differentiable in the points
    and the whitener by the implicit function theorem at the optimum; the start carries no gradient.
    """
    start = jax.lax.stop_gradient(start)
    sigma = jax.lax.stop_gradient(problem.bound) / BOUND_IN_SIGMA
    # A cost rounded at eps resolves steps of √eps.
    tolerance = float(jnp.finfo(start.xyz.dtype).eps) ** 0.5
    # The QR of a tall Jacobian costs ten times its 6×6 normal equations, which are well scaled here.
    solver = optx.LevenbergMarquardt(rtol=tolerance, atol=tolerance, linear_solver=lx.Normal(lx.Cholesky()))

    def residuals(tangent, args):
        problem, whitener = args
        whitened = whitened_residuals(start @ SE3.exp(sigma * tangent), problem, whitener)
        return jnp.sqrt(problem.weights)[:, None] * robust_residuals(whitened)

    solution = optx.least_squares(
        residuals,
        solver,
        jnp.zeros(6, start.xyz.dtype),
        args=(problem, whitener),
        max_steps=config.max_steps,
        throw=False,
        adjoint=optx.ImplicitAdjoint(linear_solver=lx.AutoLinearSolver(well_posed=False)),
    )
    motion = start @ SE3.exp(sigma * solution.value)
    finite = jnp.isfinite(motion.quat).all() & jnp.isfinite(motion.xyz).all()
    motion = jax.tree.map(lambda new, old: jnp.where(finite, new, old), motion, start)
    return motion, finite & (solution.result == optx.RESULTS.successful)


def tangent_jacobian(motion: SE3, problem: Problem, whitener: Float[Array, "n 3 3"]) -> Float[Array, "n 3 6"]:
    """Derivative of the whitened residuals by the tangent (v, ω) at the motion, [R, −R·[s]ₓ] whitened."""
    x, y, z = problem.src.T
    zero = jnp.zeros_like(x)
    minus_skew = jnp.stack(
        [jnp.stack([zero, z, -y], -1), jnp.stack([-z, zero, x], -1), jnp.stack([y, -x, zero], -1)], axis=-2
    )
    local = jnp.concatenate([jnp.broadcast_to(jnp.eye(3, dtype=x.dtype), minus_skew.shape), minus_skew], axis=-1)
    turned = jnp.einsum("nij,jk->nik", whitener, motion.rotmat(), precision=Precision.HIGHEST)
    return jnp.einsum("nik,nkl->nil", turned, local, precision=Precision.HIGHEST)


def information(
    motion: SE3, problem: Problem, whitener: Float[Array, "n 3 3"], weights: Float[Array, " n"]
) -> Float[Array, "6 6"]:
    """JᵀWJ of the whitened residuals at the motion, for the tangent (v, ω)."""
    jacobian = tangent_jacobian(motion, problem, whitener)
    return jnp.einsum("n,nij,nik->jk", weights, jacobian, jacobian, precision=Precision.HIGHEST)
