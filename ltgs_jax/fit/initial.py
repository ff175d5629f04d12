"""The initial scene, fitted to the first visit's photographs from the points of structure from motion."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh
from jaxtyping import Array, Float
from scipy.spatial import cKDTree

from ltgs_jax.geometry import C0, Camera
from ltgs_jax.render import RenderPlan, render, splat_votes
from ltgs_jax.scene import Splats

from .devices import mean_gradient, mesh_for, stacked
from .growth import faint, recycle
from .loss import photometric_loss
from .optimizer import Rates, adam, reset_moments, scale_gradients
from .views import StreamedView, View, halved, plan_for, scene_extent, size_of


@dataclass(frozen=True)
class InitialConfig:
    """How the initial scene is fitted."""

    steps: int = 800
    """Photographs that are looked at, one after another."""
    batch: int = 1
    """Of these, how many an Adam step looks at, dealt out over as many devices as divide it; its rates go with the
    square root."""
    max_splats: int = 30_000
    sh_degree: int = 1
    dssim: float = 0.2
    """λ, the weight of 1 − SSIM in the loss."""
    coarse_fraction: float = 0.3
    """Share of the steps at half resolution."""
    grow_until: float = 0.7
    """Share of the steps after which no splat is split any more."""
    grow_every: int = 100
    opacity_penalty: float = 0.005
    """Weight of the mean opacity: what no photograph needs fades and is recycled."""
    rates: Rates = field(default_factory=Rates)


class FitResult(eqx.Module):
    """Splats and the trace of the loss."""

    splats: Splats
    losses: np.ndarray


def splats_from_points(
    points: np.ndarray, colors: np.ndarray, *, capacity: int, sh_degree: int, opacity: float = 0.1
) -> Splats:
    """Splats at points [m 3] with colours [m 3] in 0…1, padded to `capacity` with invisible ones.

    Scale: the mean distance to the three nearest neighbours; identity rotation (section 3 of 3DGS).
    Raises ValueError with fewer than four points.
    """
    if len(points) < 4:
        raise ValueError(f"points: expected at least 4 to start the initial scene, got {len(points)}")
    if len(points) > capacity:
        keep = np.random.default_rng(0).choice(len(points), capacity, replace=False)
        points, colors = points[keep], colors[keep]
    distances, _ = cKDTree(points).query(points, k=4)
    spacing = np.sqrt(np.mean(distances[:, 1:] ** 2, axis=1))
    spacing = np.clip(spacing, 1e-4 * np.median(spacing) + 1e-12, np.quantile(spacing, 0.99))
    count, padding = len(points), capacity - len(points)
    sh = np.zeros((capacity, (sh_degree + 1) ** 2, 3), np.float32)
    sh[:count, 0] = (colors - 0.5) / C0
    quats = np.zeros((capacity, 4), np.float32)
    quats[:, 0] = 1
    logit = np.log(opacity / (1 - opacity))
    return Splats(
        means=jnp.asarray(np.pad(points, ((0, padding), (0, 0))), jnp.float32),
        quats=jnp.asarray(quats),
        log_scales=jnp.asarray(np.pad(np.repeat(np.log(spacing)[:, None], 3, 1), ((0, padding), (0, 0))), jnp.float32),
        logit_opacities=jnp.asarray(np.r_[np.full(count, logit), np.full(padding, -20.0)], jnp.float32),
        sh=jnp.asarray(sh),
    )


def _objective(splats: Splats, item, _, *, config: InitialConfig, plan: RenderPlan):
    camera, image, mask = item
    out = render(splats, camera, plan=plan)
    loss = photometric_loss(out.image, image.astype(splats.means.dtype) / 255, mask, dssim=config.dssim)
    return loss + config.opacity_penalty * jnp.mean(splats.opacities), (loss, out.overflow)


@eqx.filter_jit(donate="all-except-first")
def _step(inputs, splats: Splats, state, config: InitialConfig, plan: RenderPlan, mesh: Mesh):
    """One Adam step on a batch of photographs. `inputs`: cameras, images and masks, extent, progress."""
    batch, extent, progress = inputs
    gradient, loss, overflow = mean_gradient(partial(_objective, config=config, plan=plan), splats, batch, None, mesh)
    updates, state = adam().update(gradient, state)
    updates = jax.tree.map(lambda leaf: config.batch**0.5 * leaf, updates)
    steps = scale_gradients(updates, config.rates, extent, progress)
    return eqx.apply_updates(splats, steps), state, loss, overflow


@eqx.filter_jit
def _error_votes(splats: Splats, camera: Camera, image, mask, plan: RenderPlan) -> Float[Array, "n 1"]:
    """Per splat Σ αT·|residual| over the pixels that count."""
    out = render(splats, camera, plan=plan)
    residual = jnp.mean(jnp.abs(out.image - image.astype(out.image.dtype) / 255), axis=-1)
    return splat_votes(splats, camera, (residual * mask)[..., None], plan=plan)


def _error_scores(splats: Splats, views: Sequence[View | StreamedView], plans: dict) -> Float[Array, " n"]:
    """Error mass of each splat over some views."""
    return sum(_error_votes(splats, v.camera, v.image, v.mask, plans[size_of(v)]) for v in views)[:, 0]


def _plans(splats: Splats, views: Sequence[View | StreamedView]) -> dict[tuple[int, int], RenderPlan]:
    """One plan per image size."""
    sizes = sorted({size_of(view) for view in views})
    # Roomy, since every new plan is a new compilation: splats shrink while they are fitted, but their number grows.
    return {size: plan_for([(splats, v.camera) for v in views if size_of(v) == size], slack=4) for size in sizes}


def _draw(order: list[int], sizes: Sequence[tuple[int, int]], batch: int, rng: np.random.Generator) -> list[int]:
    """Indices of a batch of one size from the end of `order`, which is filled anew where it has too few."""
    drawn: list[int] = []
    while len(drawn) < batch:
        size = sizes[drawn[0]] if drawn else None
        fitting = [at for at, i in enumerate(order) if size in (None, sizes[i])]
        if fitting:
            drawn.append(order.pop(fitting[-1]))
        else:
            order[:0] = rng.permutation(len(sizes)).tolist()
    return drawn


def fit_initial(
    splats: Splats,
    views: Sequence[View | StreamedView],
    *,
    key: Array,
    config: InitialConfig = InitialConfig(),
    progress: Callable[[int, int, str], None] = lambda i, n, text: None,
) -> FitResult:
    """Fit `splats` (faint ones are free slots) to photographs: L1 + D-SSIM, Adam, growth at fixed capacity.

    `views` may differ in size, and be streamed. `progress(step, steps, text)` is called now and then.
    Raises ValueError without a view.
    """
    if not views:
        raise ValueError("views: expected at least one photograph to fit, got none")
    rng = np.random.default_rng(np.asarray(jax.random.key_data(key)).ravel().tolist())
    extent = jnp.asarray(scene_extent([view.camera for view in views]), splats.means.dtype)
    coarse_steps = int(config.coarse_fraction * config.steps)
    grow_until = int(config.grow_until * config.steps)
    rounds = max(1, grow_until // config.grow_every)
    alive = int(jnp.sum(~faint(splats)))
    growth = (splats.count / max(alive, 1)) ** (1 / rounds) * 1.1
    splats = jax.tree.map(jnp.copy, splats)  # the steps donate their buffers, and the caller's are not ours
    state = adam().init(splats)
    losses = np.zeros(config.steps, np.float32)
    coarse, mesh = coarse_steps > 0, mesh_for(config.batch)
    current, plans, order = halved(views) if coarse else list(views), {}, []
    if config.batch > 1:
        text = f"{config.batch} photographs a step, on {mesh.size} of {jax.device_count()} devices"
        progress(0, config.steps, text)
    for step in range(0, config.steps, config.batch):
        if coarse and step >= coarse_steps:
            coarse = False
            current, plans = list(views), {}
        if not plans:
            plans = _plans(splats, current)
        if step % config.grow_every < config.batch <= step <= grow_until:
            sample = [current[i] for i in rng.permutation(len(views))[:8]]
            scores = _error_scores(splats, sample, plans)
            splats, replaced = recycle(splats, scores, jnp.asarray(int((growth - 1) * alive) + 1))
            state = reset_moments(state, replaced)
            alive = int(jnp.sum(~faint(splats)))
        drawn = [current[i] for i in _draw(order, [size_of(view) for view in views], config.batch, rng)]
        batch = stacked([jax.tree.map(np.asarray, (view.camera, view.image, view.mask)) for view in drawn])
        inputs = (batch, extent, jnp.asarray(step / config.steps, splats.means.dtype))
        splats, state, loss, overflow = _step(inputs, splats, state, config, plans[size_of(drawn[0])], mesh)
        losses[step : step + config.batch] = loss
        if int(overflow) > 0:
            plans = _plans(splats, current)
        seen = min(step + config.batch, config.steps)
        if step % 50 < config.batch or seen == config.steps:
            mean = losses[max(0, seen - 1 - len(views)) : seen].mean()
            progress(seen, config.steps, f"loss {mean:.4f}, {alive} splats")
    return FitResult(splats[~faint(splats)], losses)
