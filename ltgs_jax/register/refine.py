"""Final robust least squares on the tangent of SE(3), with optimistix, and what it says about the answer."""

import equinox as eqx
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


# Of the final solve, per unit of the whitened normal equations: far under what one point adds.
_DAMPING = 1e-2
# Widths, in units of σ, of what lies near a right answer: exact pairs, and near misses on the surface around.
NEAR_WIDTHS = (1.0, 2.0, 4.0, 8.0)


class ResidualLaw(eqx.Module):
    """How residuals are spread: Gaussians of `NEAR_WIDTHS`, of heights `near` at 0, over a `flat` rest."""

    near: Float[Array, " k"]
    flat: Float[Array, ""]

    @staticmethod
    def of_bound(dtype) -> "ResidualLaw":
        """Before anything is known: one Gaussian, whose odds at the noise bound are even."""
        heights = jnp.zeros(len(NEAR_WIDTHS), dtype).at[0].set(1)
        return ResidualLaw(heights, jnp.exp(jnp.asarray(-0.5 * BOUND_IN_SIGMA**2, dtype)))

    def _terms(self, squared: Float[Array, "*n"]) -> tuple[Float[Array, "*n k"], Float[Array, " k"]]:
        precision = jnp.asarray(NEAR_WIDTHS, squared.dtype) ** -2
        return -0.5 * squared[..., None] * precision, precision

    def loss(self, squared: Float[Array, " n"]) -> Float[Array, " n"]:
        """−2·log density of squared residuals in units of σ², 0 at 0."""
        exponents, _ = self._terms(squared)
        return -2 * jnp.log1p(jnp.sum(self.near * jnp.expm1(exponents), axis=-1) / (jnp.sum(self.near) + self.flat))

    def trust(self, squared: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """Derivative of the loss: the weight of a residual, 1 for a sure exact pair."""
        exponents, precision = self._terms(squared)
        density = self.near * jnp.exp(exponents)
        return jnp.sum(density * precision, axis=-1) / (jnp.sum(density, axis=-1) + self.flat)


def robust_residuals(whitened: Float[Array, "n 3"], law: ResidualLaw) -> Float[Array, "n 3"]:
    """Residuals whose squares sum to −2·log likelihood under the law; `whitened` in units of σ."""
    squared = jnp.sum(whitened * whitened, axis=-1)
    positive = squared > 0
    safe = jnp.where(positive, squared, 1)
    factor = jnp.sqrt(jnp.where(positive, law.loss(safe) / safe, law.trust(jnp.zeros_like(safe))))
    return factor[:, None] * whitened


def probability_within(relative: Float[Array, "..."]) -> Float[Array, "..."]:
    """Weight of r²/bound² in the robust fit: its odds against the constant share of outliers."""
    return jax.nn.sigmoid(0.5 * BOUND_IN_SIGMA**2 * (1 - relative))


def inlier_probability(whitened: Float[Array, "n 3"]) -> Float[Array, " n"]:
    """Weight of each residual, in units of σ, in the robust fit."""
    return probability_within(jnp.sum(whitened * whitened, axis=-1) / BOUND_IN_SIGMA**2)


def whitened_residuals(motion: SE3, problem: Problem, whitener: Float[Array, "*n3"]) -> Float[Array, "n 3"]:
    """Residuals in units of their standard deviation; `whitener` [] where that is equal all round, else [n, 3, 3]."""
    residuals = motion.apply(problem.src) - problem.dst
    if whitener.ndim == 0:
        return whitener * residuals
    return jnp.einsum("nij,nj->ni", whitener, residuals, precision=Precision.HIGHEST)


def isotropic_whitener(problem: Problem) -> Float[Array, ""]:
    """Whitener of equal noise in all directions, whose 99 % bound is the noise bound."""
    return BOUND_IN_SIGMA / problem.bound


def approach(start: SE3, problem: Problem, whitener: Float[Array, "*n3"], law: ResidualLaw, steps: int) -> SE3:
    """Reweighted Gauss-Newton steps in closed 6×6 form: cheap, and precise where a cost is rounded away."""

    def step(_, motion):
        whitened = whitened_residuals(motion, problem, whitener)
        trust = problem.weights * law.trust(jnp.sum(whitened * whitened, axis=-1))
        normal, gradient = normal_equations(motion, problem, whitener, trust)
        # Keeps a direction that no point fixes where it is.
        ridge = jnp.finfo(normal.dtype).eps * (1 + jnp.trace(normal))
        return motion @ SE3.exp(-jnp.linalg.solve(normal + ridge * jnp.eye(6, dtype=normal.dtype), gradient))

    return jax.lax.fori_loop(0, steps, step, start)


def final_solve(
    start: SE3, problem: Problem, whitener: Float[Array, "*n3"], law: ResidualLaw, config: RegisterConfig
) -> tuple[SE3, Bool[Array, ""]]:
    """The robust optimum near `start`, and whether the solver got there.

    The unknown is the tangent in units of σ, so that tolerances mean shares of the noise. Differentiable in the points
    and the whitener by the implicit function theorem at the optimum; the start and the law carry no gradient.
    """
    start, law = jax.lax.stop_gradient((start, law))
    sigma = jax.lax.stop_gradient(problem.bound) / BOUND_IN_SIGMA
    # A cost rounded at eps resolves steps of √eps.
    tolerance = float(jnp.finfo(start.xyz.dtype).eps) ** 0.5
    # The QR of a tall Jacobian costs ten times its 6×6 normal equations, which are well scaled here.
    solver = optx.LevenbergMarquardt(rtol=tolerance, atol=tolerance, linear_solver=lx.Normal(lx.Cholesky()))
    # From a start that is at the optimum but for rounding, a trust region would judge steps by the cost's rounding and
    # refuse some; constant damping takes two steps, and only keeps directions that no point fixes from growing.
    solver = eqx.tree_at(lambda s: s.search, solver, optx.LearningRate(1 / _DAMPING))

    def residuals(tangent, args):
        problem, whitener = args
        whitened = whitened_residuals(start @ SE3.exp(sigma * tangent), problem, whitener)
        return jnp.sqrt(problem.weights)[:, None] * robust_residuals(whitened, law)

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
    converged = finite & (solution.result == optx.RESULTS.successful)
    return jax.tree.map(lambda new, old: jnp.where(converged, new, old), motion, start), converged


def _tangent_jacobian(motion: SE3, problem: Problem, whitener: Float[Array, "n 3 3"]) -> Float[Array, "n 3 6"]:
    """Derivative of the whitened residuals by the tangent (v, ω) at the motion, [R, −R·[s]ₓ] whitened."""
    x, y, z = problem.src.T
    zero = jnp.zeros_like(x)
    minus_skew = jnp.stack(
        [jnp.stack([zero, z, -y], -1), jnp.stack([-z, zero, x], -1), jnp.stack([y, -x, zero], -1)], axis=-2
    )
    local = jnp.concatenate([jnp.broadcast_to(jnp.eye(3, dtype=x.dtype), minus_skew.shape), minus_skew], axis=-1)
    turned = jnp.einsum("nij,jk->nik", whitener, motion.rotmat(), precision=Precision.HIGHEST)
    return jnp.einsum("nik,nkl->nil", turned, local, precision=Precision.HIGHEST)


def _isotropic_equations(motion: SE3, problem: Problem, trust: Float[Array, " n"]):
    """`normal_equations` of unit noise, from sums over the points: JᵀJ does not depend on the rotation."""
    src = problem.src
    local = src + jnp.matmul(motion.xyz - problem.dst, motion.rotmat(), precision=Precision.HIGHEST)
    pairs = jnp.stack([src[:, i] * src[:, j] for i in range(3) for j in range(i, 3)], axis=-1)
    rows = jnp.concatenate([jnp.ones_like(src[:, :1]), src, pairs, local, jnp.cross(src, local)], axis=-1)
    sums = jnp.matmul(trust, rows, precision=Precision.HIGHEST)
    total, (x, y, z), (xx, xy, xz, yy, yz, zz), gradient = sums[0], sums[1:4], sums[4:10], sums[10:]
    zero = jnp.zeros_like(total)
    upper = jnp.stack([zero, z, -y, -z, zero, x, y, -x, zero]).reshape(3, 3)
    turn = jnp.stack([yy + zz, -xy, -xz, -xy, xx + zz, -yz, -xz, -yz, xx + yy]).reshape(3, 3)
    shift = total * jnp.eye(3, dtype=total.dtype)
    return jnp.block([[shift, upper], [upper.T, turn]]), gradient


def normal_equations(
    motion: SE3, problem: Problem, whitener: Float[Array, "*n3"], trust: Float[Array, " n"]
) -> tuple[Float[Array, "6 6"], Float[Array, "6"]]:
    """JᵀWJ and JᵀWr of the whitened residuals at the motion, for the tangent (v, ω)."""
    if whitener.ndim == 0:
        normal, gradient = _isotropic_equations(motion, problem, trust)
        return whitener**2 * normal, whitener**2 * gradient
    whitened = whitened_residuals(motion, problem, whitener)
    jacobian = _tangent_jacobian(motion, problem, whitener)
    normal = jnp.einsum("n,nij,nik->jk", trust, jacobian, jacobian, precision=Precision.HIGHEST)
    return normal, jnp.einsum("n,nij,ni->j", trust, jacobian, whitened, precision=Precision.HIGHEST)
