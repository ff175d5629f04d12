"""A short fit of one object in windows around it, everything else held still: cost goes with the object's pixels."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ltgs_jax.geometry import Camera
from ltgs_jax.render import RenderPlan, plan_render, render
from ltgs_jax.scene import Splats

from .optimizer import Rates, adam, scale_gradients

_RATES = Rates(means=4e-3, means_final=4e-4, quats=5e-3, log_scales=1e-2, logit_opacities=8e-2, sh_dc=1e-2, sh_rest=0.0)
_FADE = 1e-2  # weight on mean opacity: what only repeats the backdrop's colours fades


class Windows(eqx.Module):
    """v windows of photographs: `cameras` batched, `target` what they show, `backdrop` and `depth` what is known there
    without the object, `valid` the pixels that count."""

    cameras: Camera
    target: Float[Array, "v s s 3"]
    backdrop: Float[Array, "v s s 3"]
    depth: Float[Array, "v s s"]
    valid: Bool[Array, "v s s"]


@eqx.filter_jit
def _step(splats: Splats, state, windows: Windows, size, progress, plan: RenderPlan):
    def objective(splats):
        out = render(splats, windows.cameras, plan=plan)
        front = (out.depth < windows.depth + 0.1 * size) | (windows.depth <= 0)
        image = jnp.where(front[..., None], out.image, 0)
        image = image + (1 - jnp.where(front, out.alpha, 0))[..., None] * windows.backdrop
        error = jnp.where(windows.valid[..., None], jnp.abs(image - windows.target), 0)
        needles = jnp.mean(jax.nn.relu(jnp.ptp(splats.log_scales, axis=-1) - jnp.log(5.0)))
        large = jnp.mean(jax.nn.relu(jnp.max(splats.scales, axis=-1) / size - 0.1))
        loss = jnp.sum(error) / jnp.maximum(3 * jnp.sum(windows.valid), 1)
        return loss + 0.01 * needles + 0.1 * large + _FADE * jnp.mean(splats.opacities), (loss, image, out.overflow)

    gradient, (loss, image, overflow) = jax.grad(objective, has_aux=True)(splats)
    updates, state = adam().update(gradient, state)
    return eqx.apply_updates(splats, scale_gradients(updates, _RATES, size, progress)), state, loss, image, overflow


def fit_local(
    splats: Splats, windows: Windows, *, size: float, steps: int
) -> tuple[Splats, Float[np.ndarray, " s"], Float[np.ndarray, "v s s 3"]]:
    """Fit an object's splats to windows of photographs by L1, with priors against needles and oversized splats.

    `size` is the object's diameter in scene units. View-dependent colour is left alone: few views cannot tell it.
    Returns the splats, the loss of every step, and the windows as the last step saw them. A step that is not finite
    ends the fit with the state before it.
    """
    state = adam().init(splats)
    plan = plan_render(splats, windows.cameras, slack=3)  # roomy: one compilation serves many objects
    images = np.asarray(windows.backdrop)
    losses = np.zeros(steps, np.float32)
    scale = jnp.asarray(size, splats.means.dtype)
    for step in range(steps):
        progress = jnp.asarray(step / steps, splats.means.dtype)
        moved, state, loss, image, overflow = _step(splats, state, windows, scale, progress, plan)
        losses[step] = loss
        if not np.isfinite(losses[step]):
            return splats, losses[:step], np.asarray(images)
        splats, images = moved, image
        if int(overflow) > 0:
            plan = plan_render(splats, windows.cameras, slack=3)
    return splats, losses, np.asarray(images)
