"""Gaussian splats as a frozen pytree."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ltgs_jax.geometry import C0, SE3, multiply_quats, rotate_sh, sh_degree, sh_rotations


class Splats(eqx.Module):
    """n anisotropic Gaussians, with the parameters stored before activation.

    `means` world frame, scene units; `quats` wxyz, need not be unit; `log_scales` natural log of the standard
    deviations; `logit_opacities`; `sh` basis-major coefficients, k = (degree+1)².
    """

    means: Float[Array, "n 3"]
    quats: Float[Array, "n 4"]
    log_scales: Float[Array, "n 3"]
    logit_opacities: Float[Array, " n"]
    sh: Float[Array, "n k 3"]

    @property
    def count(self) -> int:
        """Number of splats."""
        return self.means.shape[0]

    @property
    def scales(self) -> Float[Array, "n 3"]:
        """Standard deviations in scene units."""
        return jnp.exp(self.log_scales)

    @property
    def opacities(self) -> Float[Array, " n"]:
        """Opacities in (0, 1)."""
        return jax.nn.sigmoid(self.logit_opacities)

    def __getitem__(self, index: Bool[Array, " n"] | Int[Array, " m"] | slice) -> "Splats":
        """A subset, by mask, indices or slice; taken on the host outside transformations, where a new number of splats
        costs no compilation."""
        if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves((self, index))):
            return jax.tree.map(lambda leaf: leaf[index], self)
        rows = index if isinstance(index, slice) else np.asarray(index)
        taken = jax.tree.map(lambda leaf: np.asarray(leaf)[rows], self)
        return taken if isinstance(self.means, np.ndarray) else jax.device_put(taken)


def concatenate_splats(parts: list[Splats]) -> Splats:
    """Splats one after the other; lower SH degrees are padded with zeros to the highest.

    Splats of NumPy arrays stay on the host, where a new shape costs no compilation.
    """
    on_host = all(isinstance(leaf, np.ndarray) for leaf in jax.tree.leaves(parts))
    xp = np if on_host else jnp
    k = max(part.sh.shape[1] for part in parts)
    padded = [
        eqx.tree_at(lambda s: s.sh, part, xp.pad(part.sh, ((0, 0), (0, k - part.sh.shape[1]), (0, 0))))
        for part in parts
    ]
    return jax.tree.map(lambda *leaves: xp.concatenate(leaves), *padded)


def pad_splats(splats: Splats, multiple: int) -> Splats:
    """The splats on the host, with invisible ones after them up to a multiple, not 0: few shapes, few programs."""
    missing = -max(splats.count, 1) % multiple + max(splats.count, 1) - splats.count
    padded = jax.tree.map(lambda leaf: np.pad(np.asarray(leaf), ((0, missing),) + ((0, 0),) * (leaf.ndim - 1)), splats)
    padded.logit_opacities[splats.count :] = -np.inf
    return padded


def shade_splats(splats: Splats, log_gain: Float[Array, " n"]) -> Splats:
    """Splats with every colour times the exponential of its own gain."""
    gain = jnp.exp(log_gain)[:, None, None]
    # A colour is C0·sh_0 + 0.5 plus what depends on the direction.
    return eqx.tree_at(lambda s: s.sh, splats, (gain * splats.sh).at[:, :1].add((gain - 1) * 0.5 / C0))


def transform_splats(b_from_a: SE3, splats: Splats, owner: Int[Array, " n"] | None = None) -> Splats:
    """Move splats rigidly: means, orientations and spherical harmonics (equation 1 of the LTGS paper).

    With `owner`, `b_from_a` is a batch of motions, and splat i moves by that of `owner[i]`.
    """
    rotmat = b_from_a.rotmat().astype(splats.means.dtype)
    rotations = sh_rotations(rotmat, sh_degree(splats.sh))

    def own(leaf):
        return leaf[None] if owner is None else leaf[owner]

    return Splats(
        means=jnp.sum(own(rotmat) * splats.means[:, None, :], axis=-1) + own(b_from_a.xyz),
        quats=multiply_quats(own(b_from_a.quat), splats.quats),
        log_scales=splats.log_scales,
        logit_opacities=splats.logit_opacities,
        sh=rotate_sh(splats.sh, tuple(own(matrix) for matrix in rotations)),
    )
