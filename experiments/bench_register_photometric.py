"""Pose of one object from pixels: time against error of Levenberg–Marquardt and of Adam on the same cost.

    python experiments/bench_register_photometric.py --out FOLDER

A textured closed surface of splats before a textured wall, seen by a few cameras; starts are turned and shifted by up
to 5° and 5 % of its size. Every figure is the median over the starts; CPU time is that of all starts together, divided
by their number. Writes photometric.json and photometric.png.
"""

import json
import time
from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import optax
import tyro
from scipy.spatial.transform import Rotation

from ltgs_jax.geometry import SE3, Camera
from ltgs_jax.register.photometric import PhotometricConfig, Views, cameras_at, refine_pose
from ltgs_jax.render import plan_render, render
from ltgs_jax.scene import Splats


@dataclass(frozen=True)
class Options:
    """What to run."""

    out: Path
    """Folder of the table and the plot."""
    splats: int = 600
    views: int = 3
    side: int = 96
    """Width and height of each window, pixels."""
    starts: int = 8
    degrees: float = 5.0
    """Turn of the starts."""
    shift: float = 0.05
    """Shift of the starts, shares of the size."""
    noise: float = 0.02
    """Standard deviation of the photographs' noise, of 1."""
    lm_steps: tuple[int, ...] = (0, 2, 4, 5, 6, 8, 10, 12, 16)
    adam_steps: tuple[int, ...] = (10, 30, 100, 300)
    adam_rates: tuple[float, ...] = (3e-3, 1e-2, 3e-2)
    """Step sizes in radians and shares of the size."""
    seed: int = 0


def make_object(rng, count: int) -> Splats:
    """Splats on a bent ellipsoid of diameter 1 in smooth random colours, about the origin."""
    directions = rng.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    means = directions * (0.42 + 0.08 * np.sin(3 * directions[:, :1] + 2 * directions[:, 1:2])) * [1, 0.8, 0.7]
    colors = 0.5 + 0.45 * np.sin(means @ rng.normal(0, 8, (3, 3)) + rng.uniform(0, 6, 3))
    fields = (
        means,
        rng.normal(size=(count, 4)),
        np.log(rng.uniform(0.02, 0.045, (count, 3))),
        np.full(count, 2.5),
        ((colors - 0.5) / 0.28209479)[:, None],
    )
    return Splats(*(jnp.asarray(field, jnp.float32) for field in fields))


def make_views(rng, template: Splats, exact: SE3, options: Options) -> Views:
    """Photographs of the object at its exact pose from a ring of cameras, with noise."""
    poses = []
    for turn in np.linspace(0, 2.2, options.views):
        eye = np.array([2.2 * np.cos(turn), 2.2 * np.sin(turn), 1.0])
        z = -eye / np.linalg.norm(eye)
        x = np.cross(z, [0, 0, 1.0]) / np.linalg.norm(np.cross(z, [0, 0, 1.0]))
        matrix = np.eye(4)
        matrix[:3, :3] = np.stack([x, np.cross(z, x), z])
        matrix[:3, 3] = -matrix[:3, :3] @ eye
        poses.append(matrix)
    side = options.side
    K = np.tile([[1.6 * side, 0, side / 2], [0, 1.6 * side, side / 2], [0, 0, 1]], (options.views, 1, 1))
    cameras = Camera(
        SE3.from_matrix(jnp.asarray(np.stack(poses), jnp.float32)), jnp.asarray(K, jnp.float32), side, side
    )
    out = render(template, cameras_at(cameras, exact[None]))
    rows, columns = np.mgrid[:side, :side] / side
    wall = np.stack([0.5 + 0.2 * np.sin(11 * rows), 0.45 + 0.2 * columns, 0.5 + 0.2 * np.cos(8 * columns)], -1)
    backdrop = jnp.asarray(np.broadcast_to(wall, out.image.shape), jnp.float32)
    photographs = out.image + (1 - out.alpha)[..., None] * backdrop
    photographs = photographs + options.noise * jnp.asarray(rng.normal(size=photographs.shape), jnp.float32)
    return Views(cameras, photographs, backdrop, jnp.zeros_like(out.depth), jnp.ones_like(out.alpha, bool))


def errors(poses: SE3, exact: SE3) -> tuple[float, float]:
    """Median angle in degrees and median displacement of the middle in shares of the size."""
    relative = np.swapaxes(np.asarray(poses.rotmat(), np.float64), 1, 2) @ np.asarray(exact.rotmat(), np.float64)
    angles = np.degrees(Rotation.from_matrix(relative).magnitude())
    return float(np.median(angles)), float(np.median(np.linalg.norm(np.asarray(poses.xyz - exact.xyz), axis=-1)))


def run_lm(template: Splats, starts: SE3, exact: SE3, views: Views, options: Options) -> list[dict]:
    """The room's solver, stopped after ever more steps."""
    rows = []
    for steps in options.lm_steps:
        config = PhotometricConfig(steps=steps)
        if not rows:
            refine_pose(template, starts, views, size=1.0, reach=0.05, config=config)  # compiles
        cpu = time.process_time()
        fit = jax.block_until_ready(refine_pose(template, starts, views, size=1.0, reach=0.05, config=config))
        cpu = time.process_time() - cpu
        angle, shift = errors(fit.poses, exact)
        cost = float(np.median(fit.cost))
        row = {"solver": "levenberg-marquardt", "steps": steps, "cpu_ms": 1e3 * cpu / options.starts}
        rows.append(row | {"rotation_deg": angle, "translation_rel": shift, "cost": cost})
        print(json.dumps(rows[-1]), flush=True)
    return rows


def run_adam(template: Splats, starts: SE3, exact: SE3, views: Views, options: Options) -> list[dict]:
    """Adam on the tangent at the start, whole windows, reverse mode through the same renderer."""
    count, scale = options.starts, PhotometricConfig().scale
    plan = plan_render(template, cameras_at(views.camera, starts), slack=2)

    def cost(tangent):
        out = render(template, cameras_at(views.camera, starts @ SE3.exp(tangent)), plan=plan)
        image = out.image.reshape(count, *views.target.shape)
        clear = 1 - out.alpha.reshape(count, *views.depth.shape)
        relative = ((image + clear[..., None] * views.backdrop - views.target) / scale) ** 2
        return 0.5 * scale**2 * jnp.sum(relative / (1 + relative))

    rows = []
    for rate in options.adam_rates:
        optimizer = optax.adam(rate)

        @jax.jit
        def step(tangent, state, optimizer=optimizer):
            updates, state = optimizer.update(jax.grad(cost)(tangent), state)
            return optax.apply_updates(tangent, updates), state

        tangent = jnp.zeros((count, 6))
        state = optimizer.init(tangent)
        jax.block_until_ready(step(tangent, state))
        spent, done = 0.0, 0
        for steps in options.adam_steps:
            cpu = time.process_time()
            for _ in range(steps - done):
                tangent, state = step(tangent, state)
            jax.block_until_ready(tangent)
            spent, done = spent + time.process_time() - cpu, steps
            angle, shift = errors(starts @ SE3.exp(tangent), exact)
            row = {"solver": f"adam {rate:g}", "steps": steps, "cpu_ms": 1e3 * spent / count}
            rows.append(row | {"rotation_deg": angle, "translation_rel": shift})
            print(json.dumps(rows[-1]), flush=True)
    return rows


def draw(rows: list[dict], path: Path) -> None:
    """Error against CPU time, turn and shift."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(12, 5), layout="constrained")
    names = ("rotation_deg", "median turn, degrees"), ("translation_rel", "median shift, shares of the size")
    for axis, (name, label) in zip(axes, names, strict=True):
        for solver in dict.fromkeys(row["solver"] for row in rows):
            own = [row for row in rows if row["solver"] == solver]
            axis.loglog([row["cpu_ms"] for row in own], [row[name] for row in own], marker="o", label=solver)
        axis.set(xlabel="CPU time per start, ms", ylabel=label)
        axis.legend()
    figure.savefig(path, dpi=90)


def main(options: Options) -> None:
    """Both solvers from the same starts."""
    options.out.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(options.seed)
    template = make_object(rng, options.splats)
    exact = SE3.exp(jnp.asarray([0.05, -0.02, 0.03, 0.4, -0.3, 0.8], jnp.float32))
    views = make_views(rng, template, exact, options)
    unit = rng.normal(size=(2, options.starts, 3))
    unit /= np.linalg.norm(unit, axis=-1, keepdims=True)
    off = np.concatenate([options.shift * unit[0], np.radians(options.degrees) * unit[1]], axis=-1)
    starts = exact @ SE3.exp(jnp.asarray(off, jnp.float32))
    rows = run_lm(template, starts, exact, views, options) + run_adam(template, starts, exact, views, options)
    (options.out / "photometric.json").write_text(json.dumps(rows, indent=1))
    draw(rows, options.out / "photometric.png")


if __name__ == "__main__":
    main(tyro.cli(Options))
