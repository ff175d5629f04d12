"""The long fit: background, templates and poses together, over the photographs of all visits."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ltgs_jax.geometry import SE3
from ltgs_jax.render import RenderPlan, render
from ltgs_jax.scene import Chronology, Splats, compose

from .loss import photometric_loss
from .optimizer import Rates, adam, scale_gradients
from .views import StreamedView, View, plan_for, scene_extent, size_of


@dataclass(frozen=True)
class LongConfig:
    """How the chronology is refined (section 3.4 of the LTGS paper)."""

    steps: int = 200
    """Adam steps, one photograph each."""
    replay: float = 0.4
    """Share of the steps spent on photographs of the first visit, against forgetting."""
    dssim: float = 0.2
    """λ, the weight of 1 − SSIM in the loss."""
    background_rate: float = 0.3
    """Factor on the rates of the background's splats; templates and what is new have 1."""
    translation_rate: float = 1e-3
    """Step of a pose's translation, in units of the object's diameter."""
    rotation_rate: float = 1e-3
    """Step of a pose's rotation in radians."""
    anisotropy_penalty: float = 0.02
    """Weight that keeps template splats from becoming needles where few photographs see them."""
    fit_poses: bool = True
    rates: Rates = field(default_factory=lambda: Rates(means=2e-4, means_final=2e-5, logit_opacities=2e-2))


class VisitView(eqx.Module):
    """A photograph and the visit whose scene it shows."""

    view: View | StreamedView
    visit: int


class Placements(eqx.Module):
    """The distinct poses of a chronology: an object that stays shares one pose over its visits.

    `index` [t k] names the pose of each template at each visit; `fixed[p]`: a template's own frame, not refined.
    """

    poses: SE3
    index: Int[Array, "t k"]
    template: Int[Array, " p"]
    fixed: Bool[Array, " p"]


def placements_of(chronology: Chronology) -> Placements:
    """Equal consecutive poses of a template become one; the pose at the template's source visit is fixed."""
    quats, xyz = np.asarray(chronology.world_from_template.quat), np.asarray(chronology.world_from_template.xyz)
    visible = np.asarray(chronology.visible)
    t, k = visible.shape
    index, found, template, fixed = np.zeros((t, k), int), [], [], []
    for j in range(k):
        known: dict[bytes, int] = {}
        for i in range(t):
            name = quats[i, j].tobytes() + xyz[i, j].tobytes()
            if name not in known:
                known[name] = len(found)
                found.append((quats[i, j], xyz[i, j]))
                template.append(j)
                fixed.append(False)
            index[i, j] = known[name]
        source = min(chronology.templates[j].source_visit, t - 1)
        fixed[index[source, j]] = True
    quat = np.stack([q for q, _ in found]) if found else np.zeros((0, 4), quats.dtype)
    moved = np.stack([x for _, x in found]) if found else np.zeros((0, 3), xyz.dtype)
    return Placements(
        SE3(jnp.asarray(quat), jnp.asarray(moved)),
        jnp.asarray(index),
        jnp.asarray(np.asarray(template, int)),
        jnp.asarray(np.asarray(fixed, bool)),
    )


class _Variables(eqx.Module):
    """What is optimised: splats, and a tangent per distinct pose."""

    background: Splats
    templates: tuple[Splats, ...]
    tangents: Float[Array, "p 6"]


def _assemble(variables: _Variables, chronology: Chronology, placements: Placements) -> Chronology:
    """The chronology with the variables in place."""
    poses = placements.poses @ SE3.exp(variables.tangents)
    templates = tuple(
        eqx.tree_at(lambda m: m.splats, template, splats)
        for template, splats in zip(chronology.templates, variables.templates, strict=True)
    )
    return eqx.tree_at(
        lambda c: (c.background, c.templates, c.world_from_template),
        chronology,
        (variables.background, templates, poses[placements.index]),
    )


@eqx.filter_jit
def _step(inputs, variables, state, chronology, placements, movable, config: LongConfig, plan: RenderPlan):
    """One step on one photograph. `inputs`: camera, image, mask, visit, extent, diameters, progress."""
    camera, image, mask, visit, extent, diameters, progress = inputs
    target = image.astype(jnp.float32) / 255

    def objective(variables):
        splats = compose(_assemble(variables, chronology, placements), visit)
        out = render(splats, camera, plan=plan)
        loss = photometric_loss(out.image, target, mask, dssim=config.dssim)
        needles = sum(
            (jnp.mean(jax.nn.relu(jnp.ptp(s.log_scales, axis=-1) - jnp.log(8.0))) for s in variables.templates),
            start=jnp.asarray(0.0),
        )
        return loss + config.anisotropy_penalty * needles, (loss, out.overflow)

    gradient, (loss, overflow) = jax.grad(objective, has_aux=True)(variables)
    updates, state = adam().update(gradient, state)
    background = scale_gradients(updates.background, config.rates, extent, progress)
    background = jax.tree.map(
        lambda leaf: config.background_rate * leaf * movable.reshape((-1,) + (1,) * (leaf.ndim - 1)), background
    )
    templates = tuple(scale_gradients(u, config.rates, extent, progress) for u in updates.templates)
    # A pose of an object this photograph cannot see has no gradient, and Adam's momentum must not carry it on.
    seen = jnp.any(gradient.tangents != 0, axis=-1)
    free = ((~placements.fixed) & seen)[:, None] * float(config.fit_poses)
    rates = jnp.concatenate(
        [
            config.translation_rate * jnp.repeat(diameters[:, None], 3, axis=1),
            jnp.full((diameters.shape[0], 3), config.rotation_rate),
        ],
        axis=1,
    )
    tangents = -free * rates * (0.1**progress) * updates.tangents
    variables = eqx.apply_updates(variables, _Variables(background, templates, tangents))
    return variables, state, loss, overflow


def fit_chronology(
    chronology: Chronology,
    views: Sequence[VisitView],
    *,
    movable: Bool[Array, " n"],
    key: Array,
    config: LongConfig = LongConfig(),
    progress: Callable[[int, int, str], None] = lambda i, n, text: None,
) -> tuple[Chronology, Float[np.ndarray, " s"]]:
    """Refine background, templates and poses over photographs of all visits; no splat is added or removed.

    `movable` [n]: the background's splats that may change; all others stay bit for bit. Photographs of visit 0 are
    replayed for the share `config.replay` of the steps. Returns the chronology and the loss of every step; a run whose
    loss is not finite is stopped and the last finite state returned.

    Raises ValueError without a photograph of a later visit.
    """
    later = [i for i, v in enumerate(views) if v.visit > 0]
    first = [i for i, v in enumerate(views) if v.visit == 0]
    if not later:
        raise ValueError("views: expected photographs of a later visit, got none")
    rng = np.random.default_rng(np.asarray(jax.random.key_data(key)).ravel().tolist())
    placements = placements_of(chronology)
    extent = jnp.asarray(scene_extent([v.view.camera for v in views]), jnp.float32)
    diameters = jnp.asarray([template_diameter(t.splats) for t in chronology.templates], jnp.float32)
    diameters = diameters[placements.template] if len(placements.template) else jnp.zeros(0)
    variables = _Variables(
        chronology.background,
        tuple(t.splats for t in chronology.templates),
        jnp.zeros((placements.poses.xyz.shape[0], 6), jnp.float32),
    )
    state = adam().init(variables)
    plans: dict[tuple[int, int], RenderPlan] = {}
    losses = np.zeros(config.steps, np.float32)
    queues: dict[bool, list[int]] = {True: [], False: []}
    finite = variables
    for step in range(config.steps):
        replay = bool(first) and rng.random() < config.replay
        queue = queues[replay]
        if not queue:
            queue.extend(rng.permutation(first if replay else later).tolist())
        view = views[queue.pop()]
        size = size_of(view.view)
        if size not in plans:
            plans[size] = _plan(chronology, views, size)
        inputs = (
            view.view.camera,
            view.view.image,
            view.view.mask,
            jnp.asarray(view.visit),
            extent,
            diameters,
            jnp.asarray(step / config.steps, jnp.float32),
        )
        before = variables
        variables, state, loss, overflow = _step(
            inputs, before, state, chronology, placements, movable, config, plans[size]
        )
        losses[step] = loss
        if not np.isfinite(losses[step]):
            progress(step, config.steps, "the loss is not finite: stopped at the last good state")
            return _assemble(finite, chronology, placements), losses[:step]
        finite = before
        if int(overflow) > 0:
            plans[size] = _plan(_assemble(variables, chronology, placements), views, size)
        if step % 50 == 0 or step == config.steps - 1:
            progress(step + 1, config.steps, f"loss {losses[max(0, step - 30) : step + 1].mean():.4f}")
    return _assemble(variables, chronology, placements), losses


_SHOWN = -2.2  # logit of the opacity from which on a splat counts for the size, 0.1


def template_diameter(splats: Splats) -> float:
    """Diagonal of the box that holds the central 98 % of the splats that show along each axis, in scene units."""
    shown = np.asarray(splats.logit_opacities) > _SHOWN
    means = np.asarray(splats.means)
    low, high = np.quantile(means[shown] if shown.any() else means, [0.01, 0.99], axis=0)
    return float(np.linalg.norm(high - low))


def _plan(chronology: Chronology, views: Sequence[VisitView], size: tuple[int, int]) -> RenderPlan:
    """A plan with room for every photograph of one size."""
    chosen = [v for v in views if size_of(v.view) == size]
    scenes = {t: _composed(chronology, jnp.asarray(t)) for t in {v.visit for v in chosen}}
    return plan_for([(scenes[v.visit], v.view.camera) for v in chosen], slack=1.4)


_composed = eqx.filter_jit(compose)
