"""The background where the first visit hardly showed it, fitted to the photographs of all visits."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from ltgs_jax.render import RenderPlan, render
from ltgs_jax.scene import Chronology, Splats, compose

from .loss import photometric_loss
from .optimizer import Rates, adam, scale_gradients
from .schedule import held_out
from .views import VisitView, halved, plan_for, scene_extent, size_of

_FORGET = 1.01  # growth of the first visit's error from which on what was mended is not kept
_LAST = 0.1  # of all rates, what is left of them at the end
_COARSE = 0.7  # share of the steps on photographs of half the size, where these keep as many pixels as follow
_ENOUGH = 320  # along the longer side


@dataclass(frozen=True)
class MendConfig:
    """How what the first visit hardly showed is mended, by photographs of later visits."""

    share: float = 0.05
    """Of what photographs of later visits show of the background, the share which those of the first visit together
    show less than half as much of, from which on it is mended; above 1: never."""
    passes: int = 60
    """How often each photograph of a later visit is looked at; 0: nothing is mended."""
    replay: float = 0.67
    """Share of the steps spent on photographs of the first visit, against forgetting."""
    dssim: float = 0.2
    """λ, the weight of 1 − SSIM in the loss."""
    again: bool = True
    """Whether the visits are explained, fitted and mended a second time, from the mended first scene."""
    rates: Rates = field(default_factory=lambda: Rates(means_final=4e-4))
    """Those that the first fit begins with; all of them fall to a tenth over the steps."""


class Mended(eqx.Module):
    """The chronology, the mean absolute error of what was held out of later photographs, and of the first visit's
    photographs, each before and after, the loss of every step, and whether the chronology is the mended one: where one
    of the two errors grew, it is the one that was given."""

    chronology: Chronology
    unseen: tuple[float, float]
    first: tuple[float, float]
    losses: np.ndarray
    kept: bool


def _with(chronology: Chronology, background: Splats) -> Chronology:
    return eqx.tree_at(lambda c: c.background, chronology, background)


@eqx.filter_jit
def _scene(chronology: Chronology, background: Splats, visit) -> Splats:
    return compose(_with(chronology, background), visit)


@eqx.filter_jit(donate="all-except-first")
def _step(inputs, background: Splats, state, rates: Rates, dssim: float, plan: RenderPlan):
    """One Adam step on a whole photograph. `inputs`: the chronology, visit, camera, image, the pixels that count, the
    scene's extent, progress."""
    chronology, visit, camera, image, mask, extent, progress = inputs

    def objective(background: Splats):
        out = render(compose(_with(chronology, background), visit), camera, plan=plan)
        return photometric_loss(out.image, image.astype(jnp.float32) / 255, mask, dssim=dssim), out.overflow

    (loss, overflow), gradient = jax.value_and_grad(objective, has_aux=True)(background)
    updates, state = adam().update(gradient, state)
    moves = scale_gradients(updates, rates, extent, progress)
    moves = jax.tree.map(lambda leaf: _LAST**progress * leaf, moves)
    return eqx.apply_updates(background, moves), state, loss, overflow


@eqx.filter_jit
def _error(chronology: Chronology, background: Splats, visit, camera, image, mask, plan: RenderPlan):
    """Mean absolute error over the pixels of a mask."""
    out = render(compose(_with(chronology, background), visit), camera, plan=plan)
    return photometric_loss(out.image, image.astype(jnp.float32) / 255, mask, dssim=0)


def _smaller(seen: VisitView, left_out: Bool[np.ndarray, "h w"]) -> tuple[VisitView, Bool[np.ndarray, "h w"]]:
    """A photograph and what of it is left out at half the size, where that is enough; else as they are."""
    if max(size_of(seen.view)) < 2 * _ENOUGH:
        return seen, left_out
    (view,) = halved([seen.view])
    width, height = size_of(view)
    return VisitView(view, seen.visit), left_out[: 2 * height : 2, : 2 * width : 2]


def mend_background(
    chronology: Chronology,
    views: Sequence[VisitView],
    *,
    key: Array,
    config: MendConfig = MendConfig(),
    progress: Callable[[int, int, str], None] = lambda i, n, text: None,
) -> Mended:
    """Fit the background's splats to whole photographs of all visits, by L1 + D-SSIM and Adam, large ones at half their
    size at first; templates, poses, shades and shadows stay. No splat is added or removed.

    Of photographs of later visits squares are held out; what came of it is kept where the error there fell and the
    first visit's did not grow by more than a hundredth. Raises ValueError without photographs of both.
    """
    first, later = [v for v in views if v.visit == 0], [v for v in views if v.visit > 0]
    if not first or not later:
        raise ValueError(
            f"views: expected photographs of the first and of later visits, got {len(first)}, {len(later)}"
        )
    rng = np.random.default_rng(np.asarray(jax.random.key_data(key)).ravel().tolist())
    held = [held_out((v.view.camera.height, v.view.camera.width), rng) for v in later]
    none = [np.zeros((v.view.camera.height, v.view.camera.width), bool) for v in first]
    fine = {"first": list(zip(first, none, strict=True)), "later": list(zip(later, held, strict=True))}
    coarse = {name: [_smaller(*pair) for pair in pairs] for name, pairs in fine.items()}
    chronology = jax.tree.map(jnp.asarray, chronology)
    background = jax.tree.map(jnp.copy, chronology.background)  # the steps donate their buffers
    extent = jnp.asarray(scene_extent([v.view.camera for v in first]), jnp.float32)
    plans: dict[tuple[int, int], RenderPlan] = {}

    def replan(background: Splats) -> None:
        scenes = {t: _scene(chronology, background, jnp.asarray(t)) for t in {v.visit for v in views}}
        every = [v for sized in (fine, coarse) for pairs in sized.values() for v, _ in pairs]
        for size in {size_of(v.view) for v in every}:
            pairs = [(scenes[v.visit], v.view.camera) for v in every if size_of(v.view) == size]
            needed, held_plan = plan_for(pairs, slack=1.0), plans.get(size)
            if held_plan is None or needed.intersections > held_plan.intersections or needed.rounds > held_plan.rounds:
                plans[size] = plan_for(pairs, slack=2.5)

    def errors(background: Splats) -> tuple[float, float]:
        """Of what is held out, and of the first visit's photographs."""
        masks = [h & v.view.mask for v, h in zip(later, held, strict=True)] + [v.view.mask for v in first]
        every = []
        for v, mask in zip(later + first, masks, strict=True):
            plan = plans[size_of(v.view)]
            of = (jnp.asarray(v.visit), v.view.camera, v.view.image, mask, plan)
            every.append(float(_error(chronology, background, *of)))
        return float(np.mean(every[: len(later)])), float(np.mean(every[len(later) :]))

    replan(background)
    steps = round(config.passes * len(later) / max(1 - config.replay, 0.05))
    losses, before = np.zeros(steps, np.float32), errors(background)
    state, queues = adam().init(background), {"first": [], "later": []}
    for step in range(steps):
        name = "first" if rng.random() < config.replay else "later"
        every = (coarse if step < _COARSE * steps else fine)[name]
        queues[name] = queues[name] or rng.permutation(len(every)).tolist()
        seen, left_out = every[queues[name].pop()]
        v, at = seen.view, jnp.asarray(step / steps, jnp.float32)
        inputs = (chronology, jnp.asarray(seen.visit), v.camera, v.image, v.mask & ~left_out, extent, at)
        plan = plans[size_of(v)]
        background, state, loss, overflow = _step(inputs, background, state, config.rates, config.dssim, plan)
        losses[step] = loss
        if not np.isfinite(losses[step]):
            progress(step, steps, "the loss is not finite: nothing is mended")
            return Mended(chronology, (before[0],) * 2, (before[1],) * 2, losses[:step], False)
        if int(overflow) > 0:
            replan(background)
        if step % 100 == 0 or step == steps - 1:
            progress(step + 1, steps, f"loss {losses[max(0, step - 99) : step + 1].mean():.4f}")
    replan(background)
    after = errors(background)
    kept = steps > 0 and after[0] < before[0] and after[1] <= _FORGET * before[1]
    return Mended(
        _with(chronology, background) if kept else chronology,
        (before[0], after[0]),
        (before[1], after[1]),
        losses,
        kept,
    )
