"""Numerical stability: how errors of float32 grow with what makes numbers hard, each table down to its honest last row.

The renderer is held to `render_reference` in float64, which gets the very float32 numbers, so that rounding of the
inputs does not count: largest error of the image, and the largest relative error of the gradient over the fields of
the splats. Rotations are held to SciPy in float64, registrations to the truth that the problem was made from.
`edges` counts gradients that are not finite where a formula has an edge. bf16 and TF32 need an accelerator: these
pages were made on CPUs alone.
"""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from experiments.curves import angle_deg, in_double, random_scene, registration_problem
from experiments.engine import Run
from ltgs_jax.geometry import SE3, Camera, quat_from_rotmat
from ltgs_jax.register import register
from ltgs_jax.render import RenderPlan, plan_render, render, render_reference
from ltgs_jax.scene import Splats

_COUNT, _WIDTH, _HEIGHT = 300, 64, 48
_PLAN = RenderPlan(32768, 1024)  # roomy, so that one program serves all values of a driver


@dataclass(frozen=True)
class Hard:
    """One value of one driver."""

    driver: str
    value: float
    trials: int = 10

    @property
    def label(self) -> str:
        """For lines of progress."""
        return f"{self.driver} {self.value:g}"


def _anisotropy(value: float) -> tuple[Splats, Camera]:
    splats, camera = random_scene(_COUNT, _WIDTH, _HEIGHT)
    stretch = jnp.asarray([0.5, 0.0, -0.5]) * np.log(value)
    return _with(splats, log_scales=splats.log_scales + stretch), camera


def _depth_range(value: float) -> tuple[Splats, Camera]:
    """The same pixels and sizes on the image, depths spread over a range of this ratio."""
    splats, camera = random_scene(_COUNT, _WIDTH, _HEIGHT)
    depth = splats.means[:, 2:]
    factor = jnp.asarray(value ** np.random.default_rng(1).uniform(-0.5, 0.5, (_COUNT, 1)), jnp.float32)
    far = jnp.maximum(factor, 0.05 / depth)  # in front of the near plane
    return _with(splats, means=splats.means * far, log_scales=splats.log_scales + jnp.log(far)), camera


def _image_size(value: float) -> tuple[Splats, Camera]:
    splats, camera = random_scene(_COUNT, _WIDTH, _HEIGHT)
    return splats, camera.resized(int(value), int(value) * 3 // 4)


def _splat_count(value: float) -> tuple[Splats, Camera]:
    return random_scene(int(value), _WIDTH, _HEIGHT)


def _overdraw(value: float) -> tuple[Splats, Camera]:
    """All scales times a factor, opacities such that deep layers still show."""
    splats, camera = random_scene(_COUNT, _WIDTH, _HEIGHT)
    return _with(
        splats, log_scales=splats.log_scales + np.log(value), logit_opacities=splats.logit_opacities - 3
    ), camera


def _distance(value: float) -> tuple[Splats, Camera]:
    """Scene and a turned camera together this many scene units from the origin: their difference is what is seen."""
    splats, camera = random_scene(_COUNT, _WIDTH, _HEIGHT)
    turn = SE3(jnp.asarray([0.8, 0.3, -0.4, 0.2], jnp.float32), jnp.zeros(3))
    away = jnp.asarray([value, -value, 0.5 * value], jnp.float32)
    moved = Camera(SE3(turn.quat, -turn.apply(away[None])[0]), camera.K, camera.width, camera.height)
    return _with(splats, means=turn.inverse().apply(splats.means) + away), moved


def _with(splats: Splats, **fields) -> Splats:
    return dataclasses.replace(splats, **fields)


SCENES: dict[str, tuple[Callable[[float], tuple[Splats, Camera]], str, tuple[float, ...]]] = {
    "anisotropy": (_anisotropy, "longest / shortest axis", (1, 10, 100, 1e3, 1e4, 1e6, 1e9)),
    "depth range": (_depth_range, "far / near", (1, 10, 100, 1e3, 1e4)),
    "overdraw": (_overdraw, "factor on all scales", (0.5, 1, 2, 4, 8)),
    "distance from the origin": (_distance, "scene units", (0, 10, 100, 1e3, 1e4, 1e5, 1e6, 1e7)),
    "image size": (_image_size, "pixels across", (32, 64, 128, 256)),
    "splat count": (_splat_count, "splats", (30, 300, 1000, 3000)),
}


@jax.jit
def _weigh(image):
    """A scalar of an image that no symmetry makes flat."""
    h, w = image.shape[:2]
    weights = (
        1
        + jnp.cos(jnp.arange(h, dtype=image.dtype))[:, None, None] * jnp.sin(jnp.arange(w, dtype=image.dtype))[:, None]
    )
    return jnp.mean(weights * image * image)


@jax.jit
def _exactly(splats: Splats, camera: Camera):
    slope = jax.grad(lambda s: _weigh(render_reference(s, camera).image))(splats)
    return render_reference(splats, camera).image, slope


def _fast(plan: RenderPlan):
    @jax.jit
    def both(splats: Splats, camera: Camera):
        def value(s):
            out = render(s, camera, plan=plan)
            return _weigh(out.image), (out.image, out.overflow)

        slope, (image, overflow) = jax.grad(value, has_aux=True)(splats)
        return image, slope, overflow

    return both


_planned = _fast(_PLAN)


def run_scene(hard: Hard, folder: Path, cache: Path) -> dict:
    """Errors of image and gradient at one value of a driver of the renderer."""
    make, unit, _ = SCENES[hard.driver]
    splats, camera = make(hard.value)
    need = plan_render(splats, camera, slack=1.0)
    enough = need.intersections <= _PLAN.intersections and need.rounds <= _PLAN.rounds
    image, slope, overflow = (_planned if enough else _fast(need))(splats, camera)
    with jax.enable_x64(True):
        truth, exact = jax.device_get(_exactly(in_double(splats), in_double(camera)))
    relative = [
        np.linalg.norm(np.asarray(a, np.float64) - b) / max(np.linalg.norm(b), 1e-300)
        for a, b in zip(jax.tree.leaves(slope), jax.tree.leaves(exact), strict=True)
    ]
    error = np.abs(np.asarray(image, np.float64) - truth)
    return {
        "driver_value": hard.value,
        "driver_unit": unit,
        "of image: largest error": float(error.max()),
        "of image: mean error": float(error.mean()),
        "of pixels beyond 1/255": float((error > 1 / 255).any(axis=-1).mean()),
        "of gradient: worst relative error": float(max(relative)),
        "overflow": int(overflow),
    }


def run_angle(hard: Hard, folder: Path, cache: Path) -> dict:
    """A rotation this close to π: exp and the quaternion of its matrix in float32, against SciPy in float64."""
    axes = np.random.default_rng(2).normal(size=(200, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    tangents = np.c_[np.zeros((200, 3)), (np.pi - hard.value) * axes].astype(np.float32)
    true = Rotation.from_rotvec(tangents[:, 3:].astype(np.float64))
    made = SE3.exp(jnp.asarray(tangents))
    back = quat_from_rotmat(made.rotmat())

    def worst(quat) -> float:
        found = Rotation.from_quat(np.asarray(quat, np.float64)[:, [1, 2, 3, 0]])
        return float((found.inv() * true).magnitude().max())

    slope = jax.jacfwd(lambda t: SE3.exp(t).quat)(jnp.asarray(tangents[0]))
    return {
        "driver_value": hard.value,
        "driver_unit": "π − angle, rad",
        "of exp: radians": worst(made.quat),
        "of exp, to a matrix and back: radians": worst(back),
        "of Jacobian: entries not finite": float(jnp.sum(~jnp.isfinite(slope))),
    }


def _flattened(hard: Hard, trial: int):
    """A surface squeezed to this thickness along one axis, without outliers beyond a third."""
    src, _, rotmat, xyz = registration_problem(trial, 100, 0.0)
    src = src * [1, hard.value, hard.value]
    rng = np.random.default_rng([trial, 5])
    dst = src @ rotmat.T + xyz + 1e-3 * rng.normal(size=src.shape)
    wrong = rng.permutation(100)[:33]
    dst[wrong] = dst[np.roll(wrong, 1)]
    return src, dst, rotmat, 1e-3


def _with_outliers(hard: Hard, trial: int):
    src, dst, rotmat, _ = registration_problem(trial, 200, hard.value)
    return src, dst, rotmat, 5e-3


def run_registration(hard: Hard, folder: Path, cache: Path) -> dict:
    """Angle of registrations to the truth, and how many own up to having failed."""
    make = _flattened if hard.driver == "conditioning" else _with_outliers
    angles, refused, ambiguous = [], 0, 0
    for trial in range(hard.trials):
        src, dst, rotmat, sigma = make(hard, trial)
        answer = register(src, dst, noise_bound=3.37 * sigma)
        angles.append(angle_deg(answer.dst_from_src, rotmat))
        refused += int(answer.result) != 0
        ambiguous += bool(answer.ambiguous)
    unit = "thickness / length" if hard.driver == "conditioning" else "share of outliers, N = 200"
    return {
        "driver_value": hard.value,
        "driver_unit": unit,
        "of rotation: median degrees": float(np.median(angles)),
        "of rotation: worst degrees": float(max(angles)),
        "of share that says it failed": refused / hard.trials,
        "of share with a free axis named": ambiguous / hard.trials,
    }


def _edge_cases() -> list[tuple[str, Splats]]:
    splats, _ = random_scene(_COUNT, _WIDTH, _HEIGHT)
    one = jnp.zeros(_COUNT).at[0].set(1)
    return [
        ("a zero quaternion", _with(splats, quats=splats.quats * (1 - one)[:, None])),
        ("opacity 1 (logit 40)", _with(splats, logit_opacities=splats.logit_opacities + 40 * one)),
        ("opacity 0 (logit −∞)", _with(splats, logit_opacities=jnp.where(one > 0, -jnp.inf, splats.logit_opacities))),
        ("a scale of e⁻⁴⁰", _with(splats, log_scales=splats.log_scales - 40 * one[:, None])),
        ("a scale of e²⁰", _with(splats, log_scales=splats.log_scales + 20 * one[:, None])),
        ("at the camera", _with(splats, means=splats.means * (1 - one)[:, None])),
        ("on the near plane", _with(splats, means=splats.means.at[0].set(jnp.asarray([0, 0, 0.01])))),
        ("two in one place", _with(splats, means=splats.means.at[1].set(splats.means[0]))),
        ("colour at the clip of 0", _with(splats, sh=splats.sh.at[0].set(-0.5 / 0.28209479177387814))),
    ]


def run_edges(hard: Hard, folder: Path, cache: Path) -> dict:
    """Numbers that are not finite in image and gradient at one edge."""
    name, splats = _edge_cases()[int(hard.value)]
    _, camera = random_scene(_COUNT, _WIDTH, _HEIGHT)
    image, slope, overflow = _planned(splats, camera)
    bad = sum(int((~np.isfinite(np.asarray(leaf))).sum()) for leaf in jax.tree.leaves(slope))
    return {
        "driver_value": hard.value,
        "driver_unit": "case",
        "of what": name,
        "of image: not finite": int((~np.isfinite(np.asarray(image))).sum()),
        "of gradient: not finite": bad,
        "overflow": int(overflow),
    }


OTHERS: dict[str, tuple[str, tuple[float, ...]]] = {
    "angle near π": ("run_angle", (1.0, 1e-2, 1e-4, 1e-6, 0.0)),
    "outlier rate": ("run_registration", (0.0, 0.5, 0.9, 0.95, 0.97, 0.99)),
    "conditioning": ("run_registration", (1.0, 0.1, 0.01, 1e-3, 1e-5)),
    "gradients at the edges": ("run_edges", tuple(map(float, range(9)))),
}


def stability_runs(effort: int) -> dict[str, list[Run]]:
    """One run per driver and value, named `driver: value`."""
    here = "experiments.stability"
    runs = {
        f"{driver}: {value:g}": [Run(f"{here}:run_scene", Hard(driver, float(value)))]
        for driver, (_, _, values) in SCENES.items()
        for value in values
    }
    for driver, (task, values) in OTHERS.items():
        runs |= {f"{driver}: {v:g}": [Run(f"{here}:{task}", Hard(driver, v, 10 * effort))] for v in values}
    return runs
