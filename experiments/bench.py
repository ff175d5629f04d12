"""The gate: today's errors within 2 % and times within 30 % of a committed baseline, times as ratios to a control.

    python -m experiments.bench --quick             a few small measurements (`.ci/run` does this before the tests);
                                                    a time that grew is said, but fails only the whole gate: on another
                                                    processor the ratios are others
    python -m experiments.bench --gate              all of them
    python -m experiments.bench --update-baseline   measure all, and write experiments/bench_baseline.json anew

Only worse is a failure. A time is the CPU time of all threads over that of a fixed piece of work in the same
process, the least of up to three medians: a busy machine makes times longer, never shorter. Exit status 0 when all
keep to it, else 1.
"""

import dataclasses
import json
import math
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from experiments.curves import angle_deg, control, cpu_seconds, in_double, random_scene, registration_problem
from ltgs_jax.fit import InitialConfig, View, fit_initial
from ltgs_jax.geometry import SE3, Camera
from ltgs_jax.metrics import psnr
from ltgs_jax.register import register
from ltgs_jax.render import plan_render, render, render_reference

BASELINE = Path(__file__).with_name("bench_baseline.json")
_ERROR, _TIME = 1.02, 1.30
_ROUNDING = 2e-6
"""Absolute slack on errors: what another processor's rounding may add to a float32 image."""
_TRIES = 3


@dataclass(frozen=True)
class Options:
    """What to measure; exactly one."""

    quick: bool = False
    gate: bool = False
    update_baseline: bool = False
    report: Path | None = None
    """JSON file for what was measured."""


@dataclass(frozen=True)
class Measured:
    """An error (a number, smaller is better), and what to time again."""

    error: float
    timed: Callable[[], float]


def measure_render(count: int, width: int, height: int) -> Measured:
    """Image and gradient of random splats; the error is the mean one against the float64 reference."""
    splats, camera = random_scene(count, width, height)
    plan = plan_render(splats, camera)
    slope = jax.jit(jax.value_and_grad(lambda s: jnp.mean(render(s, camera, plan=plan).image ** 2)))
    with jax.enable_x64(True):
        truth = np.asarray(jax.jit(render_reference)(in_double(splats), in_double(camera)).image)
    image = np.asarray(render(splats, camera, plan=plan).image, np.float64)
    return Measured(float(np.abs(image - truth).mean()), lambda: cpu_seconds(slope, splats))


def measure_register(count: int, outliers: float, trials: int) -> Measured:
    """Median angle in degrees over some problems."""

    def solve(trial: int) -> tuple[SE3, np.ndarray]:
        src, dst, rotmat, _ = registration_problem(trial, count, outliers)
        return register(src, dst, noise_bound=3.37 * 0.005).dst_from_src, rotmat

    angles = [angle_deg(*solve(trial)) for trial in range(trials)]
    return Measured(float(np.median(angles)), lambda: cpu_seconds(lambda: solve(0)[0]))


def measure_fit(steps: int) -> Measured:
    """Root mean square error left at a view that was not fitted, after a short fit to renders of known splats."""
    truth, camera = random_scene(400, 64, 48)

    def at(x: float) -> Camera:
        shift = SE3(camera.cam_from_world.quat, jnp.asarray([x, 0.0, 0.0], jnp.float32))
        return Camera(shift, camera.K, camera.width, camera.height)

    def photograph(x: float) -> View:
        image = np.clip(np.asarray(render(truth, at(x)).image), 0, 1)
        return View(at(x), np.rint(255 * image).astype(np.uint8), np.ones(image.shape[:2], bool))

    views = [photograph(x) for x in (-0.4, -0.2, 0.2, 0.4)]
    start = dataclasses.replace(truth, sh=jnp.zeros_like(truth.sh), log_scales=truth.log_scales - 0.3)
    config = InitialConfig(steps=steps, coarse_fraction=0.0, grow_every=10 * steps)

    def fit():
        return fit_initial(start, views, key=jax.random.key(0), config=config).splats

    held = photograph(0.0)
    left = psnr(jnp.clip(render(fit(), held.camera).image, 0, 1), jnp.asarray(held.image / 255, jnp.float32))
    return Measured(10 ** (-float(left) / 20), lambda: cpu_seconds(fit, repeats=1))


QUICK: dict[str, Callable[[], Measured]] = {
    "render 1000 splats 96×72": lambda: measure_render(1000, 96, 72),
    "register N=100 80 % outliers": lambda: measure_register(100, 0.8, 5),
}
ALL = {
    **QUICK,
    "render 5000 splats 160×120": lambda: measure_render(5000, 160, 120),
    "register N=500 95 % outliers": lambda: measure_register(500, 0.95, 10),
    "fit 60 steps": lambda: measure_fit(60),
}


def compare(
    name: str, measured: Measured, base: dict[str, float] | None, unit: Callable[[], float] = control
) -> tuple[dict, list[str], list[str]]:
    """The row, and which errors and which times are worse than the baseline's.

    A time is taken again, with its control, while it looks long.
    """
    ratio, most = math.inf, -math.inf if base is None else _TIME * base["time_ratio"]
    for _ in range(_TRIES):
        ratio = min(ratio, measured.timed() / unit())
        if ratio <= most:
            break
    row = {"error": measured.error, "time_ratio": ratio}
    if base is None:
        return row, [f"{name}: is not in the baseline"], []
    wrong, slow = [], []
    if not measured.error <= _ERROR * base["error"] + _ROUNDING:
        wrong.append(f"{name}: error {measured.error:.3g}, baseline {base['error']:.3g}")
    if not ratio <= most:
        slow.append(f"{name}: time {ratio:.3g} of the control, baseline {base['time_ratio']:.3g}")
    return row, wrong, slow


def main(options: Options) -> int:
    """Measure, compare, say; the exit status."""
    if options.quick + options.gate + options.update_baseline != 1:
        print("expected exactly one of --quick, --gate, --update-baseline", file=sys.stderr)
        return 2
    base = json.loads(BASELINE.read_text()) if BASELINE.is_file() and not options.update_baseline else {}
    rows, wrong, slow = {}, [], []
    for name, measure in (QUICK if options.quick else ALL).items():
        rows[name], *worse = compare(name, measure(), base.get(name))
        wrong, slow = wrong + worse[0], slow + worse[1]
        print(
            f"{name}: error {rows[name]['error']:.4g}, time {rows[name]['time_ratio']:.3g} of the control", flush=True
        )
    if options.report is not None:
        options.report.write_text(json.dumps(rows, indent=1, ensure_ascii=False))
    if options.update_baseline:
        BASELINE.write_text(json.dumps(rows, indent=1, ensure_ascii=False) + "\n")
        return 0
    for problem in [*wrong, *slow]:
        print(f"worse: {problem}", file=sys.stderr)
    return 1 if wrong or (slow and options.gate) else 0


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Options, description=__doc__)))
