"""Speed against error of single rooms: renderer, registration, localisation, detection, fit. A row is one setting.

Time is CPU time of all threads as a ratio to a control in the same process (`control`), the median of several;
compilation is left out. `error_of` says what `error` is: each curve has one measure, smaller is better. Cut-offs of
the renderer (1/255, 1e-4) are constants of the image formation and cannot be set; learned front ends need the user's
weights; inner solvers of the registration are compared in experiments/bench_register_solvers.py.
"""

import dataclasses
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from experiments.captures import CaptureConfig, open_capture
from experiments.engine import Run
from experiments.scenes import SceneConfig, initial_scene, load_problem
from ltgs_jax.detect import change_map
from ltgs_jax.features import Classical
from ltgs_jax.fit import InitialConfig, fit_initial, splats_from_points
from ltgs_jax.geometry import SE3, Camera
from ltgs_jax.io import read_capture
from ltgs_jax.localize import LocalizeConfig, localize
from ltgs_jax.metrics import mask_f1, psnr
from ltgs_jax.pipeline import PRESETS, for_small_photographs
from ltgs_jax.pipeline.looks import Eye
from ltgs_jax.register import RegisterConfig, register
from ltgs_jax.render import RenderConfig, plan_render, render, render_reference
from ltgs_jax.scene import Splats

_NOISE_BOUND = 3.37  # standard deviations
_REPEATS = 5


def control() -> float:
    """CPU seconds of a fixed piece of work: 64 passes of exp over 2^16 float32, which stay in the cache."""
    return cpu_seconds(_exponentials, jnp.linspace(0, 1, 1 << 16), repeats=3 * _REPEATS)


@jax.jit
def _exponentials(x):
    return jax.lax.fori_loop(0, 64, lambda _, y: jnp.exp(-y), x)


def cpu_seconds(call: Callable, *arguments, repeats: int = _REPEATS) -> float:
    """Median CPU seconds of a call, after one that compiles."""
    jax.block_until_ready(call(*arguments))
    times = []
    for _ in range(repeats):
        start = time.process_time()
        jax.block_until_ready(call(*arguments))
        times.append(time.process_time() - start)
    return statistics.median(times)


def random_scene(count: int, width: int, height: int, seed: int = 0) -> tuple[Splats, Camera]:
    """Splats of mixed shapes in front of a camera at the origin that looks along z, in float32."""
    rng = np.random.default_rng(seed)
    depth = rng.uniform(2, 6, count)
    spread = rng.uniform(-0.6, 0.6, (count, 2)) * depth[:, None]
    splats = Splats(
        means=jnp.asarray(np.c_[spread, depth], jnp.float32),
        quats=jnp.asarray(rng.normal(size=(count, 4)), jnp.float32),
        log_scales=jnp.asarray(rng.normal(-2.8, 0.5, (count, 3)), jnp.float32),
        logit_opacities=jnp.asarray(rng.normal(0, 1.5, count), jnp.float32),
        sh=jnp.asarray(rng.normal(0, 0.6, (count, 1, 3)), jnp.float32),
    )
    focal = 0.9 * width
    K = jnp.asarray([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]], jnp.float32)
    return splats, Camera(SE3.identity(), K, width, height)


def in_double(tree):
    """The same numbers as float64; inside `jax.enable_x64(True)` only."""
    return jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf, np.float64)), tree)


@dataclass(frozen=True)
class RendererPoint:
    """A setting of the renderer; its reference is `render_reference` in float64."""

    tile_size: int = 8
    chunk: int = 16
    double: bool = False
    """Whether everything is float64."""
    splats: int = 3000
    width: int = 160
    height: int = 120


def run_renderer(point: RendererPoint, folder: Path, cache: Path) -> dict:
    """Forward and gradient against the largest error of the image."""
    splats, camera = random_scene(point.splats, point.width, point.height)
    config = RenderConfig(tile_size=point.tile_size, chunk=point.chunk)
    plan = plan_render(splats, camera, config=config)
    unit = control()
    with jax.enable_x64(True):
        truth = np.asarray(jax.jit(render_reference)(in_double(splats), in_double(camera)).image)
    with jax.enable_x64(point.double):
        if point.double:
            splats, camera = in_double(splats), in_double(camera)
        draw = jax.jit(lambda s: render(s, camera, plan=plan, config=config).image)
        slope = jax.jit(jax.grad(lambda s: jnp.mean(render(s, camera, plan=plan, config=config).image ** 2)))
        forward, gradient = cpu_seconds(draw, splats), cpu_seconds(slope, splats)
        error = np.abs(np.asarray(draw(splats), np.float64) - truth)
    return {
        "error_of": "largest error of the image",
        "error": float(error.max()),
        "error_mean": float(error.mean()),
        "seconds_ratio": gradient / unit,
        "seconds_ratio_forward": forward / unit,
    }


@dataclass(frozen=True)
class RegistrationPoint:
    """A setting of `register`, on points of a closed surface of size 1 with outliers on the object itself."""

    points: int = 32
    """Of the quick search."""
    refine_steps: int = 6
    max_steps: int = 64
    count: int = 200
    outliers: float = 0.95
    trials: int = 10


def registration_problem(seed: int, count: int, outliers: float, sigma: float = 0.005):
    """src, dst, R, t: right points at wrong places but for a share of 1 − outliers."""
    rng = np.random.default_rng([seed, count])
    directions = rng.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    src = directions * (0.4 + 0.1 * directions[:, :1] * directions[:, 1:2]) * [1.0, 0.75, 0.55]
    rotmat, xyz = Rotation.random(rng=rng).as_matrix(), rng.normal(size=3)
    partner, wrong = np.arange(count), rng.permutation(count)[: round(outliers * count)]
    partner[wrong] = np.roll(partner[wrong], 1)
    return src, src[partner] @ rotmat.T + xyz + sigma * rng.normal(size=src.shape), rotmat, xyz


def angle_deg(answer: SE3, rotmat: np.ndarray) -> float:
    """Between a motion's rotation and a matrix."""
    return float(np.degrees(Rotation.from_matrix(np.asarray(answer.rotmat(), np.float64).T @ rotmat).magnitude()))


def run_registration(point: RegistrationPoint, folder: Path, cache: Path) -> dict:
    """CPU time of one registration against the 90th percentile of the angle to the truth."""
    quick = RegisterConfig().quick
    config = dataclasses.replace(
        RegisterConfig(),
        quick=dataclasses.replace(quick, points=point.points),
        refine_steps=point.refine_steps,
        max_steps=point.max_steps,
    )
    angles, times, unit = [], [], control()
    for trial in range(point.trials):
        src, dst, rotmat, _ = registration_problem(trial, point.count, point.outliers)

        def solve(src=src, dst=dst):
            return register(src, dst, noise_bound=_NOISE_BOUND * 0.005, config=config).dst_from_src

        angles.append(angle_deg(solve(), rotmat))
        times.append(cpu_seconds(solve, repeats=1))
    return {
        "error_of": "angle to the truth in degrees, 90th percentile",
        "error": float(np.quantile(angles, 0.9)),
        "error_median": float(np.median(angles)),
        "seconds_ratio": statistics.median(times) / unit,
    }


@dataclass(frozen=True)
class PlacePoint:
    """A setting of localisation: the later photographs are placed again, and compared with their given poses."""

    max_side: int = 160
    contrast: float = 0.002
    capture: CaptureConfig = field(default_factory=lambda: CaptureConfig("move", width=240, height=180, dense=16))


def run_place(point: PlacePoint, folder: Path, cache: Path) -> dict:
    """CPU time a photograph against the median distance of the camera; a rejected one counts as infinitely far."""
    capture = read_capture(open_capture(point.capture, cache))
    unit, start = control(), time.process_time()
    found = localize(
        capture, config=LocalizeConfig(refine_given=True, max_side=point.max_side, contrast=point.contrast)
    )
    seconds = time.process_time() - start
    later = [p for p in capture.photographs if p.visit > 0 and p.role != "unused"]
    distances = [
        float(jnp.linalg.norm(found.cameras[p.name].center() - p.camera.center()))
        if p.name in found.cameras
        else np.inf
        for p in later
    ]
    return {
        "error_of": "distance of the camera in scene units, median",
        "error": float(np.median(distances)),
        "placed": sum(np.isfinite(distances)) / len(later),
        "seconds_ratio": seconds / len(later) / unit,
    }


@dataclass(frozen=True)
class DetectPoint:
    """A size at which photographs are compared with the initial scene."""

    max_side: int = 160
    capture: CaptureConfig = field(default_factory=lambda: CaptureConfig("turnover"))


def run_detect(point: DetectPoint, folder: Path, cache: Path) -> dict:
    """CPU time a photograph against 1 − F1 of the change masks, on held-out photographs of later visits."""
    config = SceneConfig(point.capture)
    problem = load_problem(config, cache)
    initial, _, _ = initial_scene(config, problem, cache)
    small = load_problem(dataclasses.replace(config, max_side=point.max_side), cache)
    eye, front_end, found, true, seconds = Eye(), Classical(), [], [], 0.0
    for held in [held for t in problem.later for held in small.test[t]]:
        look = eye.look(initial, held.view.camera, np.full(initial.count, 0.1, np.float32))
        start = time.process_time()
        image = held.view.image.astype(np.float32) / 255
        mask = change_map(look.image, image, look.expected, held.view.mask, front_end).mask
        seconds += time.process_time() - start
        found.append(mask.ravel())
        true.append(held.changed.ravel())
    return {
        "error_of": "1 − F1 of the changed pixels",
        "error": 1 - float(mask_f1(np.concatenate(found), np.concatenate(true))),
        "seconds_ratio": seconds / len(found) / control(),
    }


@dataclass(frozen=True)
class FitPoint:
    """A budget of the initial fit."""

    initial: InitialConfig = field(default_factory=lambda: SceneConfig().initial)
    capture: CaptureConfig = field(default_factory=lambda: CaptureConfig("turnover"))


def run_fit(point: FitPoint, folder: Path, cache: Path) -> dict:
    """CPU time of the second of two equal fits, which compiles nothing, against the error at held-out photographs."""
    problem = load_problem(SceneConfig(point.capture), cache)
    options, unit = point.initial, control()

    def fit():
        start = splats_from_points(
            problem.points, problem.colors, capacity=options.max_splats, sh_degree=options.sh_degree
        )
        return fit_initial(start, problem.train, key=jax.random.key(0), config=options).splats

    seconds = cpu_seconds(fit, repeats=1)
    splats, eye = fit(), Eye()
    held = problem.test[0]
    scores = [float(psnr(eye.image(splats, h.view.camera), h.view.image.astype(np.float32) / 255)) for h in held]
    return {
        "error_of": "root mean square error at held-out photographs of the first visit",
        "error": 10 ** (-float(np.mean(scores)) / 20),
        "psnr": float(np.mean(scores)),
        "seconds_ratio": seconds / unit,
    }


def curve_runs(effort: int) -> dict[str, list[Run]]:
    """All points, named `curve: setting`."""
    here = "experiments.curves"
    trials = 10 * effort
    renderer = {
        **{f"tile {tile} px": RendererPoint(tile_size=tile) for tile in (4, 8, 16)},
        **{f"chunk {chunk}": RendererPoint(chunk=chunk) for chunk in (8, 32)},
        "float64": RendererPoint(double=True),
    }
    registration = {
        **{f"{n} starts": RegistrationPoint(points=n, trials=trials) for n in (4, 32, 128)},
        **{f"{n} refinements": RegistrationPoint(refine_steps=n, trials=trials) for n in (1,)},
        **{f"{n} final steps": RegistrationPoint(max_steps=n, trials=trials) for n in (2,)},
    }
    default = SceneConfig().initial
    fits = {
        **{f"{n} steps": FitPoint(dataclasses.replace(default, steps=n)) for n in (60, 125, 250, 500)},
        **{
            f"{share:.0%} coarse": FitPoint(dataclasses.replace(default, coarse_fraction=share)) for share in (0.0, 0.6)
        },
        **{f"{n} splats": FitPoint(dataclasses.replace(default, max_splats=n)) for n in (3000, 12000)},
    }
    places = {f"{side} px": PlacePoint(max_side=side) for side in (120, 180, 240)}
    places["strong features only"] = PlacePoint(max_side=240, contrast=0.01)
    return {
        **{f"renderer: {name}": [Run(f"{here}:run_renderer", point)] for name, point in renderer.items()},
        **{f"registration: {name}": [Run(f"{here}:run_registration", point)] for name, point in registration.items()},
        **{f"fit: {name}": [Run(f"{here}:run_fit", point)] for name, point in fits.items()},
        **{f"localisation: {name}": [Run(f"{here}:run_place", point)] for name, point in places.items()},
        **{f"detection: {n} px": [Run(f"{here}:run_detect", DetectPoint(n))] for n in (60, 80, 120, 160)},
    }


def chosen_points() -> dict[str, str]:
    """Which points of the curves the presets chose, and which presets those are."""
    tiny = PRESETS["tiny"].fit.initial
    fast = for_small_photographs(PRESETS["fast"]).fit.initial
    place, detect = PlacePoint(), DetectPoint()
    return {
        f"renderer: tile {RenderConfig().tile_size} px": "all",
        f"registration: {RegisterConfig().quick.points} starts": "all",
        f"localisation: {place.capture.width} px": "all: the photographs' own size",
        f"detection: {detect.capture.width} px": "all: the photographs' own size",
        f"fit: {tiny.steps} steps": "tiny",
        f"fit: {fast.steps} steps": "fast",
    }
