"""What all methods share: options, the row of a run, and one optimisation loop for any model that gives splats."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from experiments.engine import Clock
from experiments.scenes import Answer, Problem, SceneConfig, initial_scene, load_problem, score
from ltgs_jax.fit import View, VisitView, photometric_loss
from ltgs_jax.fit.optimizer import Rates, adam
from ltgs_jax.fit.views import plan_for, scene_extent, size_of
from ltgs_jax.geometry import Camera
from ltgs_jax.render import RenderPlan, render
from ltgs_jax.scene import Splats, pad_splats

Model = TypeVar("Model", bound=eqx.Module)
SceneOf = Callable[[Model, jax.Array, jax.Array, Camera], tuple[Splats, Camera]]
"""(model, visit, index of the photograph, camera) -> what to render, and from where."""
_DECAY = 0.1  # of all rates, over a fit


@dataclass(frozen=True)
class MethodConfig:
    """Options of a baseline."""

    scene: SceneConfig = field(default_factory=SceneConfig)
    steps: int = 300
    """Optimisation steps of each of its fits."""
    seed: int = 0

    @property
    def label(self) -> str:
        """For lines of progress."""
        return self.scene.capture.label


Method = Callable[[Problem, Splats, MethodConfig], Answer]


def run_method(method: Method, config: MethodConfig, folder: Path, cache: Path) -> dict[str, float]:
    """The row of a method: its scores, and its seconds without those of the shared initial scene (kept apart)."""
    problem = load_problem(config.scene, cache)
    initial, _, seconds = initial_scene(config.scene, problem, cache)
    # Empty slots up to one size: the programs of one capture then serve the next.
    padded = jax.tree.map(jnp.asarray, pad_splats(initial, config.scene.initial.max_splats))
    with Clock() as clock:
        answer = method(problem, padded, config)
    return {**score(problem, answer, folder), **clock.row(), "seconds_initial": seconds["seconds_cpu"]}


def extent_of(problem: Problem) -> float:
    """Size of the scene, by which steps of means are scaled."""
    return scene_extent([view.camera for view in problem.train])


def splat_rates(splats: Splats, extent: float, rates: Rates = Rates(means=2e-4)) -> Splats:
    """Step sizes of each field, as arrays that broadcast."""
    degrees = jnp.full((1, splats.sh.shape[1], 1), rates.sh_rest).at[:, 0].set(rates.sh_dc)
    return Splats(
        means=jnp.full((1, 1), extent * rates.means),
        quats=jnp.full((1, 1), rates.quats),
        log_scales=jnp.full((1, 1), rates.log_scales),
        logit_opacities=jnp.full(1, rates.logit_opacities),
        sh=degrees,
    )


def later_views(problem: Problem) -> list[VisitView]:
    """The usable photographs of all later visits."""
    return [VisitView(view, t) for t in problem.later for view in problem.update[t]]


def all_views(problem: Problem) -> list[VisitView]:
    """The usable photographs of all visits."""
    return [VisitView(view, 0) for view in problem.train] + later_views(problem)


@eqx.filter_jit
def _step(inputs, model, state, rates, scene_of: SceneOf, plan: RenderPlan):
    visit, index, camera, image, mask, progress = inputs

    def objective(model):
        out = render(*scene_of(model, visit, index, camera), plan=plan)
        return photometric_loss(out.image, image.astype(jnp.float32) / 255, mask, dssim=0.2), out.overflow

    gradient, overflow = jax.grad(objective, has_aux=True)(model)
    updates, state = adam().update(gradient, state)
    model = jax.tree.map(lambda leaf, rate, up: leaf - _DECAY**progress * rate * up, model, rates, updates)
    return model, state, overflow


@eqx.filter_jit
def _shown(model, visit, index, camera, scene_of: SceneOf):
    return scene_of(model, visit, index, camera)


def fit_model(
    model: Model, rates: Model, views: Sequence[VisitView], scene_of: SceneOf, *, steps: int, seed: int
) -> Model:
    """Adam on photographs in random order; `rates` has the model's structure and broadcasts against its leaves."""
    rng = np.random.default_rng(seed)
    state = adam().init(model)
    plans: dict[tuple[int, int], RenderPlan] = {}

    def plan(size: tuple[int, int]) -> RenderPlan:
        pairs = [
            _shown(model, jnp.asarray(v.visit), jnp.asarray(i), v.view.camera, scene_of)
            for i, v in enumerate(views)
            if size_of(v.view) == size
        ]
        return plan_for(pairs, slack=2.5)

    order: list[int] = []
    for step in range(steps):
        order = order or rng.permutation(len(views)).tolist()
        i = order.pop()
        view: View = views[i].view
        size = size_of(view)
        if size not in plans:
            plans[size] = plan(size)
        progress = jnp.asarray(step / steps, jnp.float32)
        inputs = (jnp.asarray(views[i].visit), jnp.asarray(i), view.camera, view.image, view.mask, progress)
        model, state, overflow = _step(inputs, model, state, rates, scene_of, plans[size])
        if int(overflow) > 0:
            plans[size] = plan(size)
    return model
