"""After InstantSplat (Fan et al. 2024): each visit anew from its few photographs, dense points, poses refined too.

Kept: dense per-pixel points instead of sparse ones, no densification, splats and camera poses optimised together for
a short time. Left out: MASt3R/DUSt3R, which give InstantSplat its points. In their place stands the depth that the
initial scene shows at the given poses, coloured by the photograph: right where nothing changed, the surface behind
where something came. Nothing of earlier visits is kept otherwise.
"""

from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from experiments.baselines.method import MethodConfig, extent_of, fit_model, run_method, splat_rates
from experiments.scenes import Answer, Problem, per_visit_answer
from ltgs_jax.fit import View, VisitView, splats_from_points
from ltgs_jax.geometry import SE3, Camera
from ltgs_jax.render import render
from ltgs_jax.scene import Splats

_OPACITY = 0.5  # the points are dense: they show what they are from the start
_POSE_RATE = 3e-4  # scene units and radians a step


class _Scene(eqx.Module):
    """Splats, and a tangent per photograph."""

    splats: Splats
    tangents: jnp.ndarray


def few_shot(problem: Problem, initial: Splats, config: MethodConfig) -> Answer:
    """One scene per visit."""
    scenes = [initial]
    for t in problem.later:
        views = problem.update[t]
        if not views:
            scenes.append(initial)
            continue
        points, colors = (
            np.concatenate(parts) for parts in zip(*(_points(initial, v, config) for v in views), strict=True)
        )
        capacity = config.scene.initial.max_splats
        splats = splats_from_points(points, colors, capacity=capacity, sh_degree=0, opacity=_OPACITY)
        model = _Scene(splats, jnp.zeros((len(views), 6)))
        rates = _Scene(splat_rates(splats, extent_of(problem)), jnp.full((1, 1), _POSE_RATE))
        posed = [VisitView(view, t) for view in views]
        scenes.append(fit_model(model, rates, posed, _scene_of, steps=config.steps, seed=config.seed).splats)
    return per_visit_answer(scenes)


def _scene_of(model: _Scene, visit, index, camera: Camera):
    pose = SE3.exp(model.tangents[index]) @ camera.cam_from_world
    return model.splats, Camera(pose, camera.K, camera.width, camera.height)


def _points(initial: Splats, view: View, config: MethodConfig) -> tuple[np.ndarray, np.ndarray]:
    """Points and colours of every k-th pixel, so that all photographs of a visit together fit the splats allowed."""
    h, w = view.mask.shape
    stride = max(1, round(np.sqrt(3 * h * w / config.scene.initial.max_splats)))
    depth = np.asarray(render(initial, view.camera).depth)
    rows, columns = np.mgrid[stride // 2 : h : stride, stride // 2 : w : stride].reshape(2, -1)
    usable = (depth[rows, columns] > 0) & view.mask[rows, columns]
    rows, columns = rows[usable], columns[usable]
    pixels = np.stack([columns, rows], axis=-1) + 0.5
    points = view.camera.unproject(jnp.asarray(pixels, jnp.float32), jnp.asarray(depth[rows, columns]))
    return np.asarray(points), view.image[rows, columns] / 255


def run(config: MethodConfig, folder: Path, cache: Path) -> dict:
    """The row of `few-shot`."""
    return run_method(few_shot, config, folder, cache)
