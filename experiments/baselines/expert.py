"""After CL-NeRF (Wu et al. 2023): a small radiance field; each visit adds an expert, the old field is distilled.

Kept: a radiance field fitted to the first visit by volume rendering; per visit a light expert network with a gate
that says where it speaks; training on the new photographs together with rays of old cameras whose colours the field
before gives (distillation), left out where the gate says that the scene changed (their conflict-aware loss). Left
out: the hash grid and the size of the original: two layers of 64 on frequencies of position, no view dependence,
tens of seconds instead of hours. It cannot reach the sharpness of splats in that time, and the table shows it.
"""

from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float

from experiments.baselines.method import MethodConfig, run_method
from experiments.scenes import Answer, Problem, bytes_of
from ltgs_jax.fit import View
from ltgs_jax.geometry import Camera
from ltgs_jax.scene import Splats

_FREQUENCIES = 7
_WIDTH = 64
_SAMPLES = 40  # along a ray
_RAYS = 512  # in a step
_RATE = 4e-3
_SPARSE = 1e-3  # weight of the gate's mean: the expert speaks where it must
_BLOCK = 4096  # rays rendered at a time


class _Net(eqx.Module):
    """Two hidden layers."""

    layers: tuple[Float[Array, "i o"], ...]

    def __call__(self, x: Float[Array, "n i"]) -> Float[Array, "n o"]:
        for layer in self.layers[:-1]:
            x = jax.nn.relu(x @ layer)
        return x @ self.layers[-1]


def _make_net(key, outputs: int) -> _Net:
    sizes = (4 + 6 * _FREQUENCIES, _WIDTH, _WIDTH, outputs)
    keys = jax.random.split(key, 3)
    shapes = zip(keys, sizes[:-1], sizes[1:], strict=True)
    return _Net(tuple(jax.random.normal(k, (a, b)) * (2 / a) ** 0.5 for k, a, b in shapes))


class _Bounds(eqx.Module):
    """Where the scene is: its middle, its size, and how far along a ray to look, in scene units."""

    centre: Float[Array, "3"]
    size: Float[Array, ""]
    near: Float[Array, ""]
    far: Float[Array, ""]


class _Field(eqx.Module):
    """The first visit's network, and an expert per later visit so far."""

    base: _Net
    experts: tuple[_Net, ...]

    def __call__(self, points: Float[Array, "n 3"], bounds: _Bounds) -> tuple[Array, Array]:
        """Density and colour logits [n 4], and how much the last expert speaks [n]."""
        x = (points - bounds.centre) / bounds.size
        waves = [f(2.0**k * x) for k in range(_FREQUENCIES) for f in (jnp.sin, jnp.cos)]
        encoded = jnp.concatenate([jnp.ones_like(x[:, :1]), x, *waves], axis=-1)
        out, gate = self.base(encoded), jnp.zeros(len(points))
        for expert in self.experts:
            said = expert(encoded)
            gate = jax.nn.sigmoid(said[:, 4] - 2)
            out = (1 - gate[:, None]) * out + gate[:, None] * said[:, :4]
        return out, gate


def _march(field: _Field, origins, directions, bounds: _Bounds, jitter):
    """Colours [r 3] of rays and the mean gate along each, by quadrature of the volume rendering integral."""
    edges = bounds.near + (bounds.far - bounds.near) * (jnp.arange(_SAMPLES) + jitter[:, None]) / _SAMPLES
    points = origins[:, None] + edges[..., None] * directions[:, None]
    out, gate = field(points.reshape(-1, 3), bounds)
    out, gate = out.reshape(*edges.shape, 4), gate.reshape(edges.shape)
    step = (bounds.far - bounds.near) / _SAMPLES
    alpha = 1 - jnp.exp(-jax.nn.softplus(out[..., 0]) * step * 10 / bounds.size)
    clear = jnp.cumprod(jnp.concatenate([jnp.ones_like(alpha[:, :1]), 1 - alpha + 1e-6], axis=1), axis=1)
    weights = alpha * clear[:, :-1]
    colors = jnp.sum(weights[..., None] * jax.nn.sigmoid(out[..., 1:]), axis=1)
    return colors, jnp.sum(weights * gate, axis=1)


def _learn(field, trained, old, new, teacher, bounds, key):
    """Loss of one step: `new` rays have photographs' colours, `old` ones those that the teacher gives."""
    field = eqx.combine(trained, field)
    keys = jax.random.split(key)
    colors, gate = _march(field, new[0], new[1], bounds, jax.random.uniform(keys[0], (_RAYS,)))
    loss = jnp.mean((colors - new[2]) ** 2) + _SPARSE * jnp.mean(gate)
    if teacher is not None:
        jitter = jax.random.uniform(keys[1], (_RAYS,))
        remembered, _ = _march(teacher, old[0], old[1], bounds, jitter)
        colors, gate = _march(field, old[0], old[1], bounds, jitter)
        agree = jax.lax.stop_gradient(1 - gate)
        loss += jnp.mean(agree[:, None] * (colors - jax.lax.stop_gradient(remembered)) ** 2)
    return loss


@eqx.filter_jit
def _step(field, trained, state, old, new, teacher, bounds, key, progress):
    gradient = jax.grad(lambda trained: _learn(field, trained, old, new, teacher, bounds, key))(trained)
    updates, state = optax.scale_by_adam().update(gradient, state)
    return jax.tree.map(lambda leaf, up: leaf - _RATE * 0.1**progress * up, trained, updates), state


def _rays_of(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    y, x = np.mgrid[: camera.height, : camera.width].reshape(2, -1)
    centre, directions = camera.rays(jnp.asarray(np.stack([x, y], axis=-1) + 0.5, jnp.float32))
    return np.broadcast_to(np.asarray(centre), (len(x), 3)), np.asarray(directions)


def _all_rays(views: list[View]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rays = [(*_rays_of(v.camera), v.image.reshape(-1, 3) / np.float32(255)) for v in views]
    masks = np.concatenate([v.mask.ravel() for v in views])
    return tuple(np.concatenate(parts).astype(np.float32)[masks] for parts in zip(*rays, strict=True))


def _fit(field: _Field, trained_of, views, old, teacher, bounds, *, steps: int, seed: int) -> _Field:
    """Adam on random rays; `trained_of` marks the arrays that learn."""
    rng, key = np.random.default_rng(seed), jax.random.key(seed)
    trained, frozen = eqx.partition(field, trained_of(field))
    state = optax.scale_by_adam().init(trained)
    rays = _all_rays(views)

    def batch(of):
        index = rng.integers(0, len(of[0]), _RAYS)
        return tuple(part[index] for part in of)

    for step in range(steps):
        key, now = jax.random.split(key)
        progress = jnp.asarray(step / steps, jnp.float32)
        trained, state = _step(frozen, trained, state, batch(old), batch(rays), teacher, bounds, now, progress)
    return eqx.combine(trained, frozen)


def expert(problem: Problem, initial: Splats, config: MethodConfig) -> Answer:
    """A field per visit, each with one expert more than the last."""
    del initial
    bounds = _bounds(problem)
    old = _all_rays(problem.train)
    keys = jax.random.split(jax.random.key(config.seed), len(problem.visits))
    everything = lambda field: jax.tree.map(lambda _: True, field)  # noqa: E731
    field = _Field(_make_net(keys[0], 4), ())
    field = _fit(field, everything, problem.train, old, None, bounds, steps=2 * config.steps, seed=config.seed)
    fields = [field]
    for t in problem.later:
        grown = _Field(field.base, (*field.experts, _make_net(keys[t], 5)))

        def newest(field):
            marks = jax.tree.map(lambda _: False, field)
            return eqx.tree_at(lambda f: f.experts[-1], marks, jax.tree.map(lambda _: True, field.experts[-1]))

        if problem.update[t]:
            views = problem.update[t]
            field = _fit(grown, newest, views, old, fields[-1], bounds, steps=config.steps, seed=config.seed + t)
        fields.append(field)

    @eqx.filter_jit
    def show(field, origins, directions):
        return _march(field, origins, directions, bounds, jnp.full(len(origins), 0.5))[0]

    def render(visit: int, camera: Camera) -> np.ndarray:
        origins, directions = _rays_of(camera)
        blocks = []
        for start in range(0, len(origins), _BLOCK):
            part = [np.resize(rays[start : start + _BLOCK], (_BLOCK, 3)) for rays in (origins, directions)]
            blocks.append(np.asarray(show(fields[visit], *part)))
        image = np.concatenate(blocks)[: len(origins)].reshape(camera.height, camera.width, 3)
        return np.clip(image, 0, 1)

    return Answer(render, bytes_of(fields[-1]))


def _bounds(problem: Problem) -> _Bounds:
    """From the sparse points as the first visit's cameras see them."""
    points = np.asarray(problem.points, np.float32)
    depths = [np.asarray(v.camera.project(jnp.asarray(points))[1]) for v in problem.train]
    positive = np.concatenate(depths)
    positive = positive[positive > 0]
    near, far = np.quantile(positive, [0.01, 0.99])
    centre = np.median(points, axis=0)
    size = np.quantile(np.linalg.norm(points - centre, axis=1), 0.9)
    return _Bounds(jnp.asarray(centre), *(jnp.asarray(v, jnp.float32) for v in (size, 0.6 * near, 1.4 * far)))


def run(config: MethodConfig, folder: Path, cache: Path) -> dict:
    """The row of `expert`."""
    return run_method(expert, config, folder, cache)
