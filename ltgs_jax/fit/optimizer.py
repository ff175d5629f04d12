"""Per-group learning rates of 3DGS, as one optax transformation over `Splats`."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import optax
from jaxtyping import PyTree

from ltgs_jax.scene import Splats


@dataclass(frozen=True)
class Rates:
    """Adam's step sizes. `means` is in units of the scene's extent per step; the others are in the stored units."""

    means: float = 4e-4
    means_final: float = 4e-6
    quats: float = 2e-3
    log_scales: float = 1e-2
    logit_opacities: float = 5e-2
    sh_dc: float = 5e-3
    sh_rest: float = 2.5e-4


def scale_gradients(updates: Splats, rates: Rates, extent: float, progress: jax.Array) -> Splats:
    """Adam's unit updates of `Splats` times the group's rate; the means' decays exponentially with progress 0…1."""
    means_rate = extent * rates.means * (rates.means_final / rates.means) ** progress
    sh_rates = jnp.full((updates.sh.shape[1], 1), rates.sh_rest, updates.sh.dtype).at[0].set(rates.sh_dc)
    return Splats(
        means=-means_rate * updates.means,
        quats=-rates.quats * updates.quats,
        log_scales=-rates.log_scales * updates.log_scales,
        logit_opacities=-rates.logit_opacities * updates.logit_opacities,
        sh=-sh_rates * updates.sh,
    )


def adam() -> optax.GradientTransformation:
    """Adam's normalised direction, ε as in 3DGS; rates are applied by `scale_gradients`."""
    return optax.scale_by_adam(eps=1e-15)


def reset_moments(state: PyTree, rows: jax.Array) -> PyTree:
    """Zero the moments of the splats in the mask `rows` [n], whose parameters were replaced."""

    def clear(leaf):
        if leaf.ndim == 0 or leaf.shape[0] != rows.shape[0]:
            return leaf
        return jnp.where(rows.reshape((-1,) + (1,) * (leaf.ndim - 1)), jnp.zeros_like(leaf), leaf)

    return jax.tree.map(clear, state)
