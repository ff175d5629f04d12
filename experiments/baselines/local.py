"""After CL-Splats (Ackermann et al. 2025): visit after visit, only what lies in the changed region is optimised.

Kept: the scene of the visit before is compared with the new photographs; the changed pixels are lifted to the splats
that they see; new splats are laid there; only these are optimised, all others stay bit for bit; each visit is kept
as it was. No objects, no templates, nothing recognised. Left out: DINOv2 and Depth Anything (this project's own
detection and rendered depth stand in), the history's compression.
"""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from experiments.baselines.method import MethodConfig, extent_of, fit_model, run_method, splat_rates
from experiments.scenes import Answer, Problem, bytes_of, per_visit_answer
from ltgs_jax.detect import change_map
from ltgs_jax.features import Classical
from ltgs_jax.fit import View, VisitView, splats_from_points
from ltgs_jax.pipeline.looks import Eye
from ltgs_jax.scene import Splats, concatenate_splats

_EXPECTED = 0.1  # dissimilarity of an unchanged pixel: this method knows nothing of the scene's own error
_SHARE = 0.5  # of a splat's weight in changed pixels, from which on it is active
_NEW = 1024  # most splats that a visit adds
_HEIGHT = 0.03  # of the depth: how far in front of the old surface new splats are laid


def local(problem: Problem, initial: Splats, config: MethodConfig) -> Answer:
    """One scene per visit, the inactive splats shared."""
    eye, front_end, extent = Eye(), Classical(), extent_of(problem)
    slots = _empty(_NEW * len(problem.later), initial)
    scenes, kept, used = [concatenate_splats([initial, slots])], bytes_of(initial), initial.count
    rates = splat_rates(scenes[0], extent)
    for t in problem.later:
        views, scene = problem.update[t], scenes[-1]
        votes, laid = np.zeros((scene.count, 2)), []
        for view in views:
            look = eye.look(scene, view.camera, np.full(scene.count, _EXPECTED, np.float32))
            image = view.image.astype(np.float32) / 255
            mask = change_map(look.image, image, look.expected, view.mask, front_end).mask
            votes += eye.votes(scene, view.camera, np.stack([mask, np.ones_like(mask)], axis=-1).astype(np.float32))
            laid.append(_lay(view, mask, look.depth))
        points, colors = (np.concatenate(parts) for parts in zip(*laid, strict=True)) if laid else ([], [])
        if len(points) < 4:
            scenes.append(scene)
            continue
        new = splats_from_points(points, colors, capacity=_NEW, sh_degree=0)
        rows = slice(used, used + _NEW)
        grown = jax.tree.map(lambda old, add, rows=rows: old.at[rows].set(add), scene, _as_many(new, scene))
        active = votes[:, 0] > _SHARE * np.maximum(votes[:, 1], 1e-6)
        kept += round(bytes_of(scene) * float(active.mean())) + bytes_of(new)
        active[rows] = True
        used += _NEW
        posed = [VisitView(view, t) for view in views]
        free = jnp.asarray(active, jnp.float32)
        moving = jax.tree.map(lambda r, free=free: r * free.reshape((-1,) + (1,) * (r.ndim - 1)), rates)
        scenes.append(fit_model(grown, moving, posed, _as_it_is, steps=config.steps, seed=config.seed))
    return per_visit_answer(scenes, kept)


def _empty(count: int, like: Splats) -> Splats:
    """Slots for splats that are not there yet, so that no visit changes the shapes."""
    slots = jax.tree.map(lambda leaf: jnp.zeros((count, *leaf.shape[1:])), like)
    return Splats(slots.means, slots.quats.at[:, 0].set(1), slots.log_scales, slots.logit_opacities - 20, slots.sh)


def _as_many(new: Splats, like: Splats) -> Splats:
    """With as many coefficients of colour."""
    missing = like.sh.shape[1] - new.sh.shape[1]
    sh = jnp.pad(new.sh, ((0, 0), (0, missing), (0, 0)))
    return Splats(new.means, new.quats, new.log_scales, new.logit_opacities, sh)


def _as_it_is(model: Splats, visit, index, camera):
    return model, camera


def _lay(view: View, mask: np.ndarray, depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A point in front of the known surface for every other changed pixel."""
    rows, columns = np.nonzero(mask & (depth > 0))
    rows, columns = rows[::2], columns[::2]
    pixels = jnp.asarray(np.stack([columns, rows], axis=-1) + 0.5, jnp.float32)
    points = view.camera.unproject(pixels, jnp.asarray((1 - _HEIGHT) * depth[rows, columns]))
    return np.asarray(points).reshape(-1, 3), view.image[rows, columns].reshape(-1, 3) / 255


def run(config: MethodConfig, folder: Path, cache: Path) -> dict:
    """The row of `local`."""
    return run_method(local, config, folder, cache)
