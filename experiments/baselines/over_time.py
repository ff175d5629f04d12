"""One set of splats and a small network of time: a deformation field (4DGS), and step functions (Scene Chronology).

deformation, after 4DGS (Wu et al. 2024). Kept: canonical splats, a network of (position, time) that moves, turns and
scales them, both trained together on all photographs of all visits. Left out: the HexPlane grid (a plain network on
frequencies of position and time stands in), densification while training.

steps, after Neural Scene Chronology (Lin et al. 2023). Kept: what changes over time enters through an embedding that
is a sum of step functions, whose moments and sharpness are learnt, so that states between changes stay constant.
Left out: its radiance field, its illumination code; geometry changes by opacity and colour of splats, which is what
step functions of density and radiance do. Splats start from the initial scene in both.
"""

from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from experiments.baselines.method import MethodConfig, all_views, extent_of, fit_model, run_method, splat_rates
from experiments.scenes import Answer, Problem, bytes_of
from ltgs_jax.pipeline.looks import Eye
from ltgs_jax.scene import Splats

_FREQUENCIES = 5
_WIDTH = 48
_RATE = 2e-3  # of the network's weights
_STEP_WIDTH = 12  # values that each step function switches


class _Field(eqx.Module):
    """Two layers and a head that starts at zero: time changes nothing until it is learnt."""

    first: Float[Array, "i w"]
    second: Float[Array, "w w"]
    head: Float[Array, "w o"]
    centre: Float[Array, "3"]
    size: Float[Array, ""]

    def __call__(self, means: Float[Array, "n 3"], moment: Float[Array, " m"]) -> Float[Array, "n o"]:
        x = (means - jax.lax.stop_gradient(self.centre)) / jax.lax.stop_gradient(self.size)
        encoded = [f(2.0**k * jnp.pi * x) for k in range(_FREQUENCIES) for f in (jnp.sin, jnp.cos)]
        moments = jnp.broadcast_to(moment, (x.shape[0], moment.shape[0]))
        hidden = jax.nn.relu(jnp.concatenate([x, *encoded, moments], axis=-1) @ self.first)
        return jax.nn.relu(hidden @ self.second) @ self.head


def _make_field(splats: Splats, moments: int, outputs: int, seed: int) -> _Field:
    inputs = 3 + 6 * _FREQUENCIES + moments
    a, b = jax.random.split(jax.random.key(seed))
    centre = jnp.median(splats.means, axis=0)
    size = jnp.quantile(jnp.linalg.norm(splats.means - centre, axis=-1), 0.9)
    return _Field(
        jax.random.normal(a, (inputs, _WIDTH)) * (2 / inputs) ** 0.5,
        jax.random.normal(b, (_WIDTH, _WIDTH)) * (2 / _WIDTH) ** 0.5,
        jnp.zeros((_WIDTH, outputs)),
        centre,
        size,
    )


class _Deforming(eqx.Module):
    splats: Splats
    field: _Field
    visits: int = eqx.field(static=True)


def _deformed(model: _Deforming, visit, index, camera):
    del index
    time = 2 * visit / max(model.visits - 1, 1) - 1
    moment = jnp.stack([f(2.0**k * jnp.pi * time / 2) for k in range(3) for f in (jnp.sin, jnp.cos)])
    s = model.splats
    delta = model.field(jax.lax.stop_gradient(s.means), moment)
    means = s.means + 0.1 * model.field.size * delta[:, :3]
    return Splats(means, s.quats + delta[:, 3:7], s.log_scales + delta[:, 7:], s.logit_opacities, s.sh), camera


class _Stepping(eqx.Module):
    splats: Splats
    field: _Field
    moments: Float[Array, " m"]
    sharpness: Float[Array, " m"]
    values: Float[Array, "m v"]


def _stepped(model: _Stepping, visit, index, camera):
    del index
    switched = jax.nn.sigmoid(jnp.exp(model.sharpness) * (visit - model.moments))
    delta = model.field(jax.lax.stop_gradient(model.splats.means), switched @ model.values)
    s = model.splats
    sh = s.sh.at[:, 0].add(delta[:, 1:])
    return Splats(s.means, s.quats, s.log_scales, s.logit_opacities + 4 * delta[:, 0], sh), camera


def _rates(model, extent: float):
    """The splats' own rates, one for all that is learnt of time, none for what only scales the field's inputs."""
    rates = jax.tree.map(lambda leaf: jnp.full((1,) * leaf.ndim, _RATE), model)
    still = jnp.zeros(()), jnp.zeros(1)
    return eqx.tree_at(
        lambda m: (m.splats, m.field.size, m.field.centre), rates, (splat_rates(model.splats, extent), *still)
    )


def _fit(model, scene_of, problem: Problem, config: MethodConfig) -> Answer:
    rates = _rates(model, extent_of(problem))
    model = fit_model(model, rates, all_views(problem), scene_of, steps=config.steps, seed=config.seed)
    eye, show = Eye(), eqx.filter_jit(scene_of)

    def render(visit: int, camera):
        return eye.image(show(model, jnp.asarray(visit), jnp.asarray(0), camera)[0], camera)

    return Answer(render, bytes_of(model))


def deformation(problem: Problem, initial: Splats, config: MethodConfig) -> Answer:
    """4DGS-like."""
    model = _Deforming(initial, _make_field(initial, 6, 10, config.seed), len(problem.visits))
    return _fit(model, _deformed, problem, config)


def steps(problem: Problem, initial: Splats, config: MethodConfig) -> Answer:
    """Neural-Scene-Chronology-like: as many step functions as there are later visits, between the visits at first."""
    count = len(problem.visits) - 1
    model = _Stepping(
        initial,
        _make_field(initial, _STEP_WIDTH, 4, config.seed),
        jnp.arange(count, dtype=jnp.float32) + 0.5,
        jnp.full(count, 1.5),
        jax.random.normal(jax.random.key(config.seed + 1), (count, _STEP_WIDTH)),
    )
    return _fit(model, _stepped, problem, config)


def run_deformation(config: MethodConfig, folder: Path, cache: Path) -> dict:
    """The row of `deformation`."""
    return run_method(deformation, config, folder, cache)


def run_steps(config: MethodConfig, folder: Path, cache: Path) -> dict:
    """The row of `steps`."""
    return run_method(steps, config, folder, cache)
