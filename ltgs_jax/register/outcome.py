"""What goes into and comes out of a registration: options, codes, answer."""

import enum

import equinox as eqx
from jaxtyping import Array, Bool, Float, Int

from ltgs_jax.geometry import SE3


class Result(enum.IntEnum):
    """Codes of `Registration.result`."""

    SUCCESS = 0
    TOO_FEW_POINTS = 1
    NO_CONSENSUS = 2
    NOT_CONVERGED = 3

    @property
    def reason(self) -> str:
        """The code in words."""
        return {
            Result.SUCCESS: "a rigid motion with a consensus that chance does not explain",
            Result.TOO_FEW_POINTS: "fewer than 3 usable correspondences: a rigid motion cannot be known",
            Result.NO_CONSENSUS: "no rigid motion agrees with more correspondences than chance would",
            Result.NOT_CONVERGED: "the final least squares did not converge",
        }[self]


class Effort(eqx.Module):
    """How much a search looks at; all static."""

    points: int = eqx.field(static=True)
    """Most correspondences around which a local consensus set is grown."""
    pairs: int = eqx.field(static=True)
    """Most pairs around which one is grown, where correspondences are few."""
    finalists: int = eqx.field(static=True)
    """Hypotheses that are refined at the noise bound before one is chosen."""
    bound_factors: tuple[float, ...] = eqx.field(static=True)
    """Factors of the noise bound at which it looks."""


class RegisterConfig(eqx.Module):
    """Options of `register`; all static."""

    first: Effort = eqx.field(static=True, default=Effort(points=16, pairs=0, finalists=6, bound_factors=(1.0,)))
    """The first search; where its answer stands out from chance and has the noise that was said, the only one."""
    quick: Effort = eqx.field(
        static=True, default=Effort(points=32, pairs=0, finalists=6, bound_factors=(1.0, 4.0, 0.25))
    )
    """The search of what the first left open."""
    thorough: Effort = eqx.field(
        static=True, default=Effort(points=1024, pairs=512, finalists=16, bound_factors=(1.0,))
    )
    """The searches of what both left open."""
    anneal: tuple[float, ...] = eqx.field(static=True, default=(4.0, 2.0, 1.0))
    """Bounds of the Geman-McClure annealing of each hypothesis, in units of the noise bound."""
    refine_steps: int = eqx.field(static=True, default=6)
    """Reweighted closed-form steps of each finalist."""
    bound_factors: tuple[float, ...] = eqx.field(static=True, default=(1.0, 2.0, 0.5, 4.0, 0.25))
    """Factors of the noise bound that are tried in turn until one settles the matter."""
    settle: float = eqx.field(static=True, default=5.0)
    """Score above the null, in units of the null's spread, at which no further bound is tried."""
    level_steps: int = eqx.field(static=True, default=4)
    """Reweighted closed-form steps at each noise level."""
    approach_steps: int = eqx.field(static=True, default=5)
    """Reweighted Gauss-Newton steps of the winner before the final solve."""
    max_steps: int = eqx.field(static=True, default=64)
    """Levenberg-Marquardt steps of the final solve."""
    min_distinction: float = eqx.field(static=True, default=1.5)
    """Score above the null, in units of the null's spread, under which the answer is called NO_CONSENSUS."""
    ambiguous_ratio: float = eqx.field(static=True, default=0.02)
    """Variance of the inliers across their longest axis, as a share of that along it, under which a rotation about it
    is free."""
    estimate_scale: bool = eqx.field(static=True, default=False)
    """Whether `dst` may be a scaled copy: dst = scale·R·src + t."""


class Registration(eqx.Module):
    """The answer of `register`.

    `dst_from_src` SE(3), the best motion found even when `result` names a failure (the identity without 3 usable
    points); `scale` 1 unless it was asked for. `inlier_weights` [n] in [0, 1]; `inliers` how many residuals lie under
    `noise_bound`, the bound that was used in the end; `residual` their root mean square, in the unit of the points.
    `covariance` [6 6] of the tangent (v, ω) at `dst_from_src`, right perturbation. `result` a code of `Result`;
    `confidence` in [0, 1] that the answer is within 5° and 5 % of the diameter; `distinction` how far the consensus
    stands above that of permuted correspondences, in units of its spread. `ambiguous_axis` a unit vector in the frame
    of `src` about which the rotation is not fixed, zero where there is none. `second` the next motion that other
    correspondences agree on, with their count `second_inliers` (0 where chance explains it).
    """

    dst_from_src: SE3
    inlier_weights: Float[Array, " n"]
    inliers: Int[Array, ""]
    residual: Float[Array, ""]
    scale: Float[Array, ""]
    covariance: Float[Array, "6 6"]
    result: Int[Array, ""]
    confidence: Float[Array, ""]
    distinction: Float[Array, ""]
    noise_bound: Float[Array, ""]
    ambiguous_axis: Float[Array, "3"]
    second: SE3
    second_inliers: Int[Array, ""]

    @property
    def ambiguous(self) -> Bool[Array, ""]:
        """Whether the rotation about `ambiguous_axis` is free."""
        return (self.ambiguous_axis != 0).any(-1)
