"""Plain 3DGS: the initial scene untouched, all photographs as one scene, each visit refitted, each visit dense.

Kept of 3DGS (Kerbl et al. 2023): the model, the loss, Adam with its rates per group. Left out: its densification by
screen-space gradients (`fit_initial` grows at a fixed capacity instead), opacity resets, 30 000 iterations.

- untouched: knows nothing of later visits.
- 3dgs-all: `fit_initial` on the photographs of every visit together, from the sparse points.
- 3dgs-refit: the scene of the visit before, optimised on the few photographs of this visit alone.
- 3dgs-dense: `fit_initial` at each visit from nothing, on 40 photographs of that very visit (built-in captures only).
  A bound: no other method may look at so many. Its sparse points are those of the first visit.
"""

import dataclasses
from pathlib import Path

import jax

from experiments.baselines.method import MethodConfig, extent_of, fit_model, run_method, splat_rates
from experiments.captures import dense_later
from experiments.scenes import Answer, Problem, bytes_of, load_problem, per_visit_answer
from ltgs_jax.fit import VisitView, fit_initial, splats_from_points
from ltgs_jax.scene import Splats

_DENSE = 40


def untouched(problem: Problem, initial: Splats, config: MethodConfig) -> Answer:
    """The initial scene at every visit."""
    del config
    return per_visit_answer([initial] * len(problem.visits), bytes_of(initial))


def all_photographs(problem: Problem, initial: Splats, config: MethodConfig) -> Answer:
    """One scene for all photographs."""
    del initial
    views = problem.train + [view for t in problem.later for view in problem.update[t]]
    fitted = _from_points(problem, views, config)
    return per_visit_answer([fitted] * len(problem.visits), bytes_of(fitted))


def refit(problem: Problem, initial: Splats, config: MethodConfig) -> Answer:
    """Each visit from the one before, on its own photographs alone."""
    scenes, rates = [initial], splat_rates(initial, extent_of(problem))
    for t in problem.later:
        views = [VisitView(view, t) for view in problem.update[t]]
        fitted = fit_model(scenes[-1], rates, views, _as_it_is, steps=config.steps, seed=config.seed) if views else None
        scenes.append(fitted or scenes[-1])
    return per_visit_answer(scenes)


def _as_it_is(model: Splats, visit, index, camera):
    return model, camera


def _from_points(problem: Problem, views, config: MethodConfig) -> Splats:
    options = config.scene.initial
    start = splats_from_points(problem.points, problem.colors, capacity=options.max_splats, sh_degree=options.sh_degree)
    return fit_initial(start, views, key=jax.random.key(config.seed), config=options).splats


def run_untouched(config: MethodConfig, folder: Path, cache: Path) -> dict:
    """The row of `untouched`."""
    return run_method(untouched, config, folder, cache)


def run_all_photographs(config: MethodConfig, folder: Path, cache: Path) -> dict:
    """The row of `3dgs-all`."""
    return run_method(all_photographs, config, folder, cache)


def run_refit(config: MethodConfig, folder: Path, cache: Path) -> dict:
    """The row of `3dgs-refit`."""
    return run_method(refit, config, folder, cache)


def run_dense(config: MethodConfig, folder: Path, cache: Path) -> dict:
    """The row of `3dgs-dense`. Raises ValueError for a capture that is not built in."""
    if not config.scene.capture.built_in:
        raise ValueError("3dgs-dense: needs a built-in capture, of which more photographs can be made")
    many = load_problem(dataclasses.replace(config.scene, capture=dense_later(config.scene.capture, _DENSE)), cache)

    def dense(problem: Problem, initial: Splats, config: MethodConfig) -> Answer:
        return per_visit_answer([initial, *(_from_points(problem, many.update[t], config) for t in problem.later)])

    return run_method(dense, config, folder, cache)
