"""The long fit: background, templates and poses together, over the photographs of all visits."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh
from jaxtyping import Array, Bool, Float, Int, PyTree

from ltgs_jax.geometry import SE3
from ltgs_jax.render import RenderPlan, render
from ltgs_jax.scene import (
    Chronology,
    Shadows,
    Splats,
    compose,
    concatenate_splats,
    ground_gain,
    pad_splats,
    shade_splats,
    transform_splats,
)

from .devices import mean_gradient, mesh_for, stacked
from .loss import photometric_loss
from .optimizer import Rates, adam, scale_gradients
from .schedule import Draws, Watch, held_out
from .shadows import lay_blobs
from .views import VisitView, plan_for, scene_extent, size_of
from .windows import Shown, Window, window_side, windows_of, within_change

_PRICE = 1e-3  # of a shadow's gain, as the slope of the loss


@dataclass(frozen=True)
class LongConfig:
    """How the chronology is refined (section 3.4 of the LTGS paper), in the parts of photographs that changed."""

    passes: int = 16
    """How often each window of a later photograph is looked at; 0: nothing is refined."""
    batch: int = 1
    """Windows that an Adam step looks at, dealt out over as many devices as divide it; its rates go with the square
    root."""
    replay: float = 0.4
    """Share of the steps spent on photographs of the first visit, against forgetting."""
    window: float = 0.275
    """Side of a window, as a share of the photographs' longer side."""
    dssim: float = 0.2
    """λ, the weight of 1 − SSIM in the loss."""
    background_rate: float = 1.0
    """Factor on the rate of the colours of the background's splats that the first visit showed, close to an object;
    where these are, how large and how opaque, stays. 0: the colours stay too."""
    translation_rate: float = 1e-3
    """Step of a pose's translation, in units of the object's diameter."""
    rotation_rate: float = 1e-3
    """Step of a pose's rotation in radians."""
    anisotropy_penalty: float = 0.02
    """Weight that keeps template splats from becoming needles where few photographs see them."""
    shade_rate: float = 5e-2
    """Step of an object's shade at a pose, in log gain and that over the object's diameter, and of the shadow that it
    casts there; 0: it looks everywhere as where it was first seen."""
    fit_poses: bool = True
    rates: Rates = field(default_factory=lambda: Rates(means=2e-4, means_final=2e-5, logit_opacities=2e-2))


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
    """What is optimised: splats, a tangent and a shade per distinct pose, and the gains of the shadows' blobs."""

    splats: Splats
    tangents: Float[Array, "p 6"]
    shades: Float[Array, "p 4"]
    shadows: Float[Array, " m"]


class _Fixed(eqx.Module):
    """What stays: the ground's other splats, and since when they show; whose the variable ones are (0 the ground's,
    1 + k template k's), since when the ground's show, whether they belong to a template or came after the first visit,
    and whether their colours depend on no direction, and shall not; shadows without their gains; the middle and
    diameter, of the ground and every template, that shades are measured by; poses, the diameter of each pose's object,
    and the scene's extent."""

    ground: Splats
    ground_since: Int[Array, " m"]
    owner: Int[Array, " n"]
    since: Int[Array, " n"]
    came: Bool[Array, " n"]
    plain: Bool[Array, " n"]
    shadows: Shadows
    frames: Float[Array, "k 4"]
    placements: Placements
    diameters: Float[Array, " p"]
    extent: Float[Array, ""]


class _Look(eqx.Module):
    """What an item of a step's batch looks at: a window, which of its pixels are held out, which of the variable splats
    and of the ground's show in it (padded with their counts), and where among the rows of the whole batch its own
    lie."""

    window: Window
    held: Bool[Array, "s s"]
    rows: Int[Array, " m"]
    ground_rows: Int[Array, " g"]
    place: Int[Array, " m"]


def _window_splats(variables: _Variables, look: _Look, fixed: _Fixed) -> Splats:
    """What shows in a window, of its variable splats, where and how lit they are at that visit, and of the ground's."""
    rows, visit = look.rows, look.window.visit
    splats, index = variables.splats, fixed.placements.index[visit]
    here = (fixed.placements.poses @ SE3.exp(variables.tangents))[index]
    still = SE3.identity((1,), splats.means.dtype)
    here = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), still, here)
    owner = _taken(fixed.owner, rows)
    shade = jnp.pad(variables.shades[index], ((1, 0), (0, 0)))[owner]
    along = (splats.means - fixed.frames[owner, :3]) / fixed.frames[owner, 3:]
    shadows = eqx.tree_at(lambda s: s.log_gain, fixed.shadows, variables.shadows)
    since = _taken(fixed.since, rows)
    places = jax.lax.stop_gradient(splats.means)  # no splat is pulled into a shadow
    gain = jnp.where(owner == 0, ground_gain(shadows, places, since, visit), shade[:, 0])
    lit = shade_splats(splats, gain + jnp.sum(shade[:, 1:] * along, axis=-1))
    moved = transform_splats(here, _hide_padding(lit, rows, fixed.owner.shape[0]), owner)
    ground = (fixed.ground, fixed.ground_since)
    around, since = _taken(ground, look.ground_rows)
    around = shade_splats(around, ground_gain(shadows, around.means, since, visit))
    return concatenate_splats([moved, _hide_padding(around, look.ground_rows, fixed.ground.count)])


def _taken(tree: PyTree, rows: Int[Array, " m"]) -> PyTree:
    """Rows of every leaf; those beyond its end are its last."""
    return jax.tree.map(lambda leaf: leaf.at[rows].get(mode="clip"), tree)


def _hide_padding(splats: Splats, rows, count: int) -> Splats:
    """Rows that name no splat do not show."""
    return eqx.tree_at(lambda s: s.logit_opacities, splats, jnp.where(rows < count, splats.logit_opacities, -jnp.inf))


def _objective(variables: _Variables, look: _Look, fixed: _Fixed, *, config: LongConfig, plan: RenderPlan):
    """Loss of a window with the splats of the batch's rows; beside it, what it is without the price of needles and the
    mean absolute error of what is held out, and the overflow."""
    window, own = look.window, _taken(variables.splats, look.place)
    out = render(_window_splats(eqx.tree_at(lambda v: v.splats, variables, own), look, fixed), window.camera, plan=plan)
    target = window.image.astype(jnp.float32) / 255
    loss = photometric_loss(out.image, target, window.mask & ~look.held, dssim=config.dssim)
    unseen = photometric_loss(out.image, target, window.mask & look.held, dssim=0)
    needle = jax.nn.relu(jnp.ptp(own.log_scales, axis=-1) - jnp.log(8.0))
    mine = (_taken(fixed.owner, look.rows) > 0) & (look.rows < fixed.owner.shape[0])
    needles = jnp.sum(jnp.where(mine, needle, 0)) / jnp.maximum(jnp.sum(mine), 1)
    return loss + config.anisotropy_penalty * needles, (jnp.stack([loss, unseen]), out.overflow)


@eqx.filter_jit(donate="all-except-first")
def _step(inputs, variables: _Variables, state, config: LongConfig, plan: RenderPlan, mesh: Mesh):
    """One step on a batch of windows. `inputs`: what is fixed, the batch, its rows of the variable splats, progress.
    Only those rows, and their moments, are touched."""
    fixed, looks, rows, progress = inputs

    def put(tree, part):
        return jax.tree.map(lambda leaf, new: leaf.at[rows].set(new, mode="drop"), tree, part)

    came = _taken(fixed.came, rows)
    local = eqx.tree_at(lambda v: v.splats, variables, _taken(variables.splats, rows))
    objective = partial(_objective, config=config, plan=plan)
    gradient, loss, overflow = mean_gradient(objective, local, looks, fixed, mesh)
    # What a window hardly shows of a shadow is held to nothing.
    leaning = jnp.where(gradient.shadows != 0, gradient.shadows + _PRICE * variables.shadows, 0)
    gradient = eqx.tree_at(lambda g: g.shadows, gradient, leaning)
    rows_of = partial(eqx.tree_at, lambda v: v.splats, replace_fn=lambda splats: _taken(splats, rows))
    before = state._replace(mu=rows_of(state.mu), nu=rows_of(state.nu))
    updates, after = adam().update(gradient, before)
    updates = jax.tree.map(lambda leaf: config.batch**0.5 * leaf, updates)
    moves = scale_gradients(updates.splats, config.rates, fixed.extent, progress)
    colours = jnp.where(came, 1, config.background_rate)[:, None, None] * moves.sh
    moves = jax.tree.map(lambda leaf: jnp.where(came.reshape((-1,) + (1,) * (leaf.ndim - 1)), leaf, 0), moves)
    colours = colours.at[:, 1:].multiply(~_taken(fixed.plain, rows)[:, None, None])
    moves = eqx.tree_at(lambda m: m.sh, moves, colours)
    # A pose of an object that this window does not show has no gradient, and Adam's momentum must not carry it on.
    seen = jnp.any(gradient.tangents != 0, axis=-1)
    free = (seen & ~fixed.placements.fixed)[:, None]
    pace = jnp.where(jnp.arange(6) < 3, config.translation_rate * fixed.diameters[:, None], config.rotation_rate)
    pace = 0.1**progress * pace * config.fit_poses
    tangents = variables.tangents - jnp.where(free, pace * updates.tangents, 0)
    pace = 0.1**progress * config.shade_rate
    shades = variables.shades - jnp.where(free, pace * updates.shades, 0)
    cast = gradient.shadows != 0
    shadows = variables.shadows - jnp.where(cast, pace * updates.shadows, 0)
    variables = _Variables(put(variables.splats, eqx.apply_updates(local.splats, moves)), tangents, shades, shadows)

    def merged(old: _Variables, new: _Variables) -> _Variables:
        return _Variables(
            put(old.splats, new.splats),
            jnp.where(seen[:, None], new.tangents, old.tangents),
            jnp.where(seen[:, None], new.shades, old.shades),
            jnp.where(cast, new.shadows, old.shadows),
        )

    return variables, after._replace(mu=merged(state.mu, after.mu), nu=merged(state.nu, after.nu)), loss, overflow


def fit_chronology(
    chronology: Chronology,
    views: Sequence[VisitView],
    *,
    key: Array,
    since: int = 1,
    config: LongConfig = LongConfig(),
    progress: Callable[[int, int, str], None] = lambda i, n, text: None,
) -> tuple[Chronology, Float[np.ndarray, " s"]]:
    """Refine templates, poses and the background around them over photographs of all visits; no splat is added or
    removed, and the cost goes with the pixels that changed.

    Windows of the photographs hold what templates show, and ground that a later visit brought to light (`windows_of`);
    background splats close to an object, that show hardly outside of it, may change; all others stay bit for bit.
    Windows of visit 0, and of those before visit `since`, which an earlier fit has seen, are replayed for the share
    `config.replay` of the steps, half and half; shades and shadows go on from those that there are. Of the windows of
    later visits, squares are held out: where their error has not fallen for a third of the passes, the fit ends, and
    goes back to where it was least; so it does when a loss is not finite. Returns the chronology and the loss of every
    step.

    Raises ValueError without a photograph of a visit from `since` on.
    """
    if not any(v.visit >= max(since, 1) for v in views):
        raise ValueError(f"views: expected photographs of a later visit, {max(since, 1)} or beyond, got none")
    if config.passes == 0:
        return chronology, np.zeros(0, np.float32)
    side = window_side([size_of(v.view) for v in views], config.window)
    background, templates = chronology.background, chronology.templates
    owner = np.repeat(np.arange(1 + len(templates)), [background.count, *(m.splats.count for m in templates)])
    shows_from = np.zeros(len(owner), np.int32)
    if chronology.since is not None:
        shows_from[: background.count] = chronology.since
    came = (owner > 0) | (shows_from > 0)
    visits = {}
    for t in sorted({v.visit for v in views}):
        splats = jax.tree.map(np.asarray, _composed(chronology, jnp.asarray(t)))
        shown = tuple(v.view for v in views if v.visit == t)
        visits[t] = Shown(shown, splats, came & (splats.logit_opacities > -np.inf))
    windows, votes = windows_of(visits, side=side)
    every = jax.tree.map(np.array, concatenate_splats([background, *(m.splats for m in templates)]))
    placements = placements_of(chronology)
    diameters = np.asarray([template_diameter(m.splats) for m in templates], np.float32)
    middles = [np.median(m.splats.means, axis=0) for m in templates]
    frames = np.concatenate([[[0, 0, 0, 1]], np.c_[np.reshape(middles, (-1, 3)), diameters]])
    near = came | _close_to_objects(every, frames[1:], placements)
    shadows = _shadows_of(chronology, placements, frames[1:])
    may_change = (owner > 0) | (near & within_change(votes))
    free, held = np.flatnonzero(may_change), np.flatnonzero(~may_change)
    fixed = _Fixed(
        jax.device_put(pad_splats(every[held], 1)),
        jnp.asarray(shows_from[held]),
        jnp.asarray(owner[free]),
        jnp.asarray(shows_from[free]),
        jnp.asarray(came[free]),
        # What the few photographs of a later visit show tells no colour that depends on the direction.
        jnp.asarray(~every.sh[free, 1:].any(axis=(1, 2))),
        shadows,
        jnp.asarray(frames, jnp.float32),
        placements,
        jnp.asarray(diameters[np.asarray(placements.template)]),
        jnp.asarray(scene_extent([v.view.camera for v in views]), jnp.float32),
    )
    tangents = jnp.zeros((len(placements.template), 6), jnp.float32)
    shades = _shades_of(chronology, placements, frames[1:])
    start = _Variables(jax.device_put(every[free]), tangents, shades, shadows.log_gain)
    rows = [(_rows_among(w.rows, free), _rows_among(w.rows, held)) for w in windows]
    fitted, losses = _fit_windows(start, fixed, windows, rows, key=key, since=since, config=config, progress=progress)
    for leaf, new in zip(jax.tree.leaves(every), jax.tree.leaves(fitted.splats), strict=True):
        leaf[free] = np.asarray(new)
    return _with_fitted(chronology, every, fixed, fitted), losses


def _with_fitted(chronology: Chronology, every: Splats, fixed: _Fixed, fitted: _Variables) -> Chronology:
    """The chronology with all its splats in one row, and poses, shades and shadows, as they came out."""
    background, templates, placements = chronology.background, chronology.templates, fixed.placements
    ends = np.cumsum([background.count, *(m.splats.count for m in templates)])
    parts = [every[slice(a, b)] for a, b in zip([0, *ends[:-1]], ends, strict=True)]
    poses = (placements.poses @ SE3.exp(fitted.tangents))[placements.index]
    slopes = fitted.shades[:, 1:] / fixed.diameters[:, None]
    constants = fitted.shades[:, 0] - jnp.sum(slopes * fixed.frames[1 + placements.template, :3], axis=-1)
    shade = jnp.concatenate([constants[:, None], slopes], axis=-1)[placements.index]
    shadows = eqx.tree_at(lambda s: s.log_gain, fixed.shadows, fitted.shadows)
    fitted_chronology = eqx.tree_at(
        lambda c: (c.background, *(m.splats for m in c.templates), c.world_from_template, c.shade, c.shadows),
        chronology,
        (*parts, poses, shade, shadows),
        is_leaf=lambda leaf: leaf is None,
    )
    return jax.tree.map(jnp.asarray, fitted_chronology)


def _shades_of(chronology: Chronology, placements: Placements, frames: Float[np.ndarray, "k 4"]) -> Float[Array, "p 4"]:
    """The shade of each distinct pose: its constant at the middle of the template, and its slope in diameters."""
    shades = np.zeros((len(placements.template), 4), np.float32)
    if chronology.shade is not None:
        index = np.asarray(placements.index)
        for t, k in np.ndindex(index.shape):
            constant, slope = np.split(np.asarray(chronology.shade[t, k]), [1])
            shades[index[t, k]] = np.r_[constant + slope @ frames[k, :3], slope * frames[k, 3]]
    return jnp.asarray(shades)


def _shadows_of(chronology: Chronology, placements: Placements, frames: Float[np.ndarray, "k 4"]) -> Shadows:
    """Shadows of every place at which an object stands at some visits and not at others: as strong as those that there
    are just so, else without effect."""
    template, index = np.asarray(placements.template), np.asarray(placements.index)
    middles = placements.poses.apply(jnp.asarray(frames[template, None, :3], jnp.float32))[:, 0]
    here = index[:, template] == np.arange(len(template))
    occupied = here & np.asarray(chronology.visible)[:, template]
    laid = lay_blobs(chronology.background, np.asarray(middles), frames[template, 3], occupied)
    if chronology.shadows is None:
        return laid

    def names(shadows: Shadows) -> list[bytes]:
        return [row.tobytes() for row in np.c_[np.asarray(shadows.centers), np.asarray(shadows.radii)]]

    gains = dict(zip(names(chronology.shadows), np.asarray(chronology.shadows.log_gain), strict=True))
    strengths = np.asarray([gains.get(name, 0) for name in names(laid)], np.float32)
    return eqx.tree_at(lambda s: s.log_gain, laid, jnp.asarray(strengths))


def _close_to_objects(
    splats: Splats, frames: Float[np.ndarray, "k 4"], placements: Placements
) -> Bool[np.ndarray, " n"]:
    """Splats that lie whole within a sphere of twice an object's size around a place where it stood: what floats
    before the cameras would take on what a window shows, and veil other views with it."""
    close = np.zeros(splats.count, bool)
    reach = 2 * np.exp(splats.log_scales.max(axis=-1))
    for k, pose in zip(np.asarray(placements.template), placements.poses.as_matrix(), strict=True):
        middle = np.asarray(pose)[:3] @ np.append(frames[k, :3], 1)
        close |= np.linalg.norm(splats.means - middle, axis=-1) + reach < frames[k, 3]
    return close


def _rows_among(rows: Int[np.ndarray, " m"], chosen: Int[np.ndarray, " n"]) -> Int[np.ndarray, " k"]:
    """Where in `chosen`, sorted, those of `rows` lie that are in it."""
    at = np.searchsorted(chosen, rows)
    return at[np.append(chosen, -1)[at] == rows]


def _fit_windows(
    variables: _Variables,
    fixed: _Fixed,
    windows: Sequence[Window],
    rows,
    *,
    key,
    since: int,
    config: LongConfig,
    progress,
) -> tuple[_Variables, Float[np.ndarray, " s"]]:
    """The steps, each on windows drawn at random."""
    rng = np.random.default_rng(np.asarray(jax.random.key_data(key)).ravel().tolist())
    draws = Draws(windows, since=since, replay=config.replay, rng=rng)
    mesh = mesh_for(config.batch)
    steps = draws.steps(config.passes, config.batch)
    losses = np.zeros(steps, np.float32)
    if steps == 0:
        progress(0, 1, "nothing that changed shows in any photograph: nothing is refined")
        return variables, losses
    dealt = "" if config.batch == 1 else f"; {config.batch} a step, on {mesh.size} of {jax.device_count()} devices"
    told = f"{len(draws.later)} windows of later visits, {len(draws.first)} of the first"
    progress(0, steps, told + (f", {len(draws.seen)} fitted before" if draws.seen else "") + dealt)
    looks = _looks(windows, rows, fixed, since, rng)
    state, plan = adam().init(variables), _plan(variables, looks, fixed)
    watch = Watch(variables, every=len(draws.later), passes=config.passes)
    for step in range(steps):
        chosen = [draws.draw() for _ in range(config.batch)]
        batch, united = _united([looks[i] for i in chosen], fixed.owner.shape[0])
        inputs = (fixed, batch, united, jnp.asarray(step / steps, jnp.float32))
        variables, state, loss, overflow = _step(inputs, variables, state, config, plan, mesh)
        losses[step], unseen = np.asarray(loss)
        if not np.isfinite(losses[step]):
            progress(step, steps, "the loss is not finite: stopped at the last good state")
            return watch.best, losses[:step]
        if int(overflow) > 0:
            plan = _plan(variables, looks, fixed)
        if step % 100 == 0 or step == steps - 1:
            progress(step + 1, steps, f"loss {losses[max(0, step - 100) : step + 1].mean():.4f}")
        held = sum(windows[i].visit >= since for i in chosen)
        if watch.over(variables, error=config.batch * float(unseen), drawn=held):
            text = f"what is held out came out best after {watch.passes} passes: stopped, and back to it"
            progress(step, steps, text)
            return watch.best, losses[: step + 1]
    return variables, losses


def _looks(windows: Sequence[Window], rows, fixed: _Fixed, since: int, rng: np.random.Generator) -> list[_Look]:
    """Each window by itself, on the host, all of one shape and its visit traced, so that one program serves all; of
    those of later visits, squares are held out."""
    counts = (fixed.owner.shape[0], fixed.ground.count)
    lengths = [max(256, -(-max(len(pair[kind]) for pair in rows) // 256) * 256) for kind in (0, 1)]
    looks = []
    for window, pair in zip(windows, rows, strict=True):
        own, ground = (_padded(r, length, count) for r, length, count in zip(pair, lengths, counts, strict=True))
        window = eqx.tree_at(lambda w: (w.visit, w.rows), window, (np.asarray(window.visit), None))
        held = held_out(window.mask.shape, rng) & (window.visit >= since)
        looks.append(_Look(jax.tree.map(np.asarray, window), held, own, ground, np.arange(len(own), dtype=np.int32)))
    return looks


def _united(looks: Sequence[_Look], count: int) -> tuple[_Look, Int[np.ndarray, " r"]]:
    """Looks as a batch, and the rows of the variable splats that show in any of them, padded with `count`."""
    rows = np.unique(np.concatenate([look.rows for look in looks]))
    rows = _padded(rows[rows < count], sum(len(look.rows) for look in looks), count)
    placed = [eqx.tree_at(lambda x: x.place, look, np.searchsorted(rows, look.rows).astype(np.int32)) for look in looks]
    return stacked(placed), rows


def _plan(variables: _Variables, looks: Sequence[_Look], fixed: _Fixed) -> RenderPlan:
    return plan_for([(_shown(variables, look, fixed), look.window.camera) for look in looks], slack=1.4)


@eqx.filter_jit
def _shown(variables: _Variables, look: _Look, fixed: _Fixed) -> Splats:
    return _window_splats(eqx.tree_at(lambda v: v.splats, variables, _taken(variables.splats, look.rows)), look, fixed)


def _padded(rows: Int[np.ndarray, " m"], length: int, count: int) -> Int[np.ndarray, " n"]:
    """Rows up to a length, with `count`, which names none."""
    return np.pad(rows, (0, length - len(rows)), constant_values=count).astype(np.int32)


_SHOWN = -2.2  # logit of the opacity from which on a splat counts for the size, 0.1


def template_diameter(splats: Splats) -> float:
    """Diagonal of the box that holds the central 98 % of the splats that show along each axis, in scene units."""
    shown = np.asarray(splats.logit_opacities) > _SHOWN
    means = np.asarray(splats.means)
    low, high = np.quantile(means[shown] if shown.any() else means, [0.01, 0.99], axis=0)
    return float(np.linalg.norm(high - low))


_composed = eqx.filter_jit(compose)
