"""Time and accuracy of the renderer on workload files: one row per workload, and plots.

    python experiments/bench_render.py --workloads FOLDER --out FILE.json [--plots FOLDER] [--growth]

A workload is an .npz with means, quats, scales, opacities, colors, sh, viewmat, K, width, height, background, target.
Gradient means forward + backward of mean |image − target| for means, quats, log-scales, logit-opacities and colours.
"""

import argparse
import json
import platform
import resource
import statistics
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from ltgs_jax.geometry import SE3, Camera
from ltgs_jax.render import RenderConfig, plan_render, render
from ltgs_jax.scene import Splats

REPEATS = 7


def load_workload(path: Path) -> tuple[Splats, Camera, jax.Array, jax.Array, jax.Array]:
    """Splats, camera, colours, background and target of a workload file, in float32."""
    with np.load(path) as data:
        arrays = {key: np.asarray(data[key]) for key in data.files}

    def single(key):
        return jnp.asarray(arrays[key], jnp.float32)

    opacities = arrays["opacities"].astype(np.float64)
    splats = Splats(
        means=single("means"),
        quats=single("quats"),
        log_scales=jnp.log(single("scales")),
        logit_opacities=jnp.asarray(np.log(opacities) - np.log1p(-opacities), jnp.float32),
        sh=single("sh")[:, :1],
    )
    camera = Camera(SE3.from_matrix(single("viewmat")), single("K"), int(arrays["width"]), int(arrays["height"]))
    return splats, camera, single("colors"), single("background"), single("target")


def paint(splats: Splats, camera: Camera, colors, background) -> np.ndarray:
    """The image in float64 by NumPy, splat by splat within its box: the reference for errors of large workloads."""
    cam, K = camera.cam_from_world, np.asarray(camera.K, np.float64)
    width, height = camera.width, camera.height

    def rotations(quats):
        w, x, y, z = (quats / np.linalg.norm(quats, axis=-1, keepdims=True)).T
        rows = [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
        return np.moveaxis(np.asarray(rows), -1, 0)

    def double(x):
        return np.asarray(x, np.float64)

    world = rotations(double(cam.quat)[None])[0]
    local = double(splats.means) @ world.T + double(cam.xyz)
    z = np.where(local[:, 2] >= 0.01, local[:, 2], 1)
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    tan_x = np.clip(local[:, 0] / z, (-cx - 0.15 * width) / fx, (1.15 * width - cx) / fx)
    tan_y = np.clip(local[:, 1] / z, (-cy - 0.15 * height) / fy, (1.15 * height - cy) / fy)
    zero = np.zeros_like(z)
    jacobian = np.stack(
        [np.stack([fx / z, zero, -fx * tan_x / z], -1), np.stack([zero, fy / z, -fy * tan_y / z], -1)], axis=1
    )
    factor = jacobian @ world @ (rotations(double(splats.quats)) * np.exp(double(splats.log_scales))[:, None])
    covars = factor @ factor.transpose(0, 2, 1) + 0.3 * np.eye(2)
    a, b, c = covars[:, 0, 0], covars[:, 0, 1], covars[:, 1, 1]
    det = a * c - b * b
    u, v = fx * local[:, 0] / z + cx, fy * local[:, 1] / z + cy
    opacities = 1 / (1 + np.exp(-double(splats.logit_opacities)))
    reach = np.sqrt(2 * np.log(np.maximum(255 * opacities, 1)))
    shown = (local[:, 2] >= 0.01) & (opacities >= 1 / 255)
    image, transmittance = np.zeros((height, width, colors.shape[1])), np.ones((height, width))
    colors = double(colors)
    for i in np.argsort(local[:, 2], kind="stable"):
        half_x, half_y = reach[i] * np.sqrt(a[i]) + 1, reach[i] * np.sqrt(c[i]) + 1
        x0, x1 = max(0, int(u[i] - half_x)), min(width, int(u[i] + half_x) + 1)
        y0, y1 = max(0, int(v[i] - half_y)), min(height, int(v[i] + half_y) + 1)
        if not shown[i] or x0 >= x1 or y0 >= y1:
            continue
        dx, dy = np.arange(x0, x1) + 0.5 - u[i], (np.arange(y0, y1) + 0.5 - v[i])[:, None]
        exponent = 0.5 * (c[i] * dx * dx - 2 * b[i] * dx * dy + a[i] * dy * dy) / det[i]
        alpha = np.minimum(opacities[i] * np.exp(-exponent), 0.99)
        before = transmittance[y0:y1, x0:x1]
        weight = np.where((alpha >= 1 / 255) & (before > 1e-4), alpha * before, 0)
        image[y0:y1, x0:x1] += weight[..., None] * colors[i]
        transmittance[y0:y1, x0:x1] -= weight
    return image + transmittance[..., None] * double(background)


def measure(call) -> tuple[float, float]:
    """Median wall and CPU milliseconds of a call."""
    wall, cpu = [], []
    for _ in range(REPEATS):
        wall_start, cpu_start = time.perf_counter(), time.process_time()
        jax.block_until_ready(call())
        wall.append(1e3 * (time.perf_counter() - wall_start))
        cpu.append(1e3 * (time.process_time() - cpu_start))
    return statistics.median(wall), statistics.median(cpu)


def control() -> float:
    """CPU milliseconds of exp of 2^24 float32: what the other figures are multiples of."""
    values = jnp.asarray(np.random.default_rng(0).random(2**24), jnp.float32)
    exp = jax.jit(jnp.exp)
    jax.block_until_ready(exp(values))
    return measure(lambda: exp(values))[1]


def bench(name: str, splats, camera, colors, background, target, *, config: RenderConfig, reference: bool) -> dict:
    """One row of the table."""
    plan = plan_render(splats, camera, config=config, slack=1)

    def draw(splats, colors):
        return render(splats, camera, background=background, colors=colors, plan=plan, config=config)

    def loss(splats, colors):
        return jnp.mean(jnp.abs(draw(splats, colors).image - target))

    start = time.perf_counter()
    forward = jax.jit(lambda splats, colors: draw(splats, colors).image).lower(splats, colors).compile()
    gradient = jax.jit(jax.value_and_grad(loss, argnums=(0, 1))).lower(splats, colors).compile()
    compile_s = time.perf_counter() - start
    image = jax.block_until_ready(forward(splats, colors))
    jax.block_until_ready(gradient(splats, colors))
    before = control()
    forward_ms, gradient_ms = measure(lambda: forward(splats, colors)), measure(lambda: gradient(splats, colors))
    memory = gradient.memory_analysis()
    row = {
        "workload": name,
        "n": splats.count,
        "width": camera.width,
        "height": camera.height,
        "sh_degree": 0,
        "forward_wall_ms": forward_ms[0],
        "forward_cpu_ms": forward_ms[1],
        "gradient_wall_ms": gradient_ms[0],
        "gradient_cpu_ms": gradient_ms[1],
        "control_cpu_ms": (before + control()) / 2,
        "compile_s": compile_s,
        "peak_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        "program_mb": (memory.temp_size_in_bytes + memory.output_size_in_bytes) / 2**20,
        "overflow": int(draw(splats, colors).overflow),
        "intersections": plan.intersections,
    }
    if reference:
        row["gradient_min_cosine"] = gradient_cosine(splats, camera, colors, background, target, config)
        error = np.abs(np.asarray(image, np.float64) - paint(splats, camera, colors, background)).max(axis=-1)
        row["image_max_error"] = float(error.max())
        row["pixels_beyond_2e-5"] = int((error > 2e-5).sum())
        row["image_mean_error"] = float(error.mean())
    return row


def gradient_cosine(splats, camera, colors, background, target, config: RenderConfig) -> float:
    """Least cosine between float32 and float64 gradients, over means, quats, log-scales, logit-opacities, colours."""

    def gradients(splats, camera, colors, background, target):
        plan = plan_render(splats, camera, config=config, slack=1)

        def loss(splats, colors):
            output = render(splats, camera, background=background, colors=colors, plan=plan, config=config)
            return jnp.mean(jnp.abs(output.image - target))

        found, of_colors = jax.jit(jax.grad(loss, argnums=(0, 1)))(splats, colors)
        lanes = (found.means, found.quats, found.log_scales, found.logit_opacities, of_colors)
        return [np.asarray(lane, np.float64).ravel() for lane in lanes]

    inputs = (splats, camera, colors, background, target)
    single = gradients(*inputs)
    with jax.enable_x64(True):
        double = gradients(*jax.tree.map(lambda x: jnp.asarray(np.asarray(x, np.float64)), inputs))
    return min(float(a @ b / np.sqrt((a @ a) * (b @ b))) for a, b in zip(single, double, strict=True))


def subsample(splats: Splats, colors, count: int, factor: float) -> tuple[Splats, jax.Array]:
    """`count` splats drawn from a scene (again and again, jittered, when it has fewer), scales times `factor`."""
    rng = np.random.default_rng(0)
    index = rng.permutation(splats.count)[:count] if count <= splats.count else rng.integers(0, splats.count, count)
    jitter = 0.01 * rng.standard_normal((count, 3)) * (count > splats.count)
    chosen = splats[jnp.asarray(index)]
    return Splats(
        means=chosen.means + jnp.asarray(jitter, jnp.float32),
        quats=chosen.quats,
        log_scales=chosen.log_scales + float(np.log(factor)),
        logit_opacities=chosen.logit_opacities,
        sh=chosen.sh,
    ), colors[jnp.asarray(index)]


def growth(path: Path, config: RenderConfig) -> list[dict]:
    """Rows for growth in splats (at the same covered area), in pixels and in overdraw, from the largest workload."""
    splats, camera, colors, background, _ = load_workload(path)
    rows = []

    def add(name, splats, colors, camera, **driver):
        target = jnp.zeros((camera.height, camera.width, 3))
        row = bench(name, splats, camera, colors, background, target, config=config, reference=False)
        rows.append(row | driver)

    for count in (10_000, 30_000, 100_000, 300_000, 1_000_000):
        add("splats", *subsample(splats, colors, count, (splats.count / count) ** 0.5), camera)
    some, some_colors = subsample(splats, colors, 50_000, 2.0)
    for width in (160, 320, 640, 1280):
        add("pixels", some, some_colors, camera.resized(width, width * camera.height // camera.width))
    for factor in (0.5, 1.0, 2.0, 4.0):
        add("overdraw", *subsample(splats, colors, 50_000, factor), camera.resized(320, 240), covered_area=factor**2)
    return rows


def plot(rows: list[dict], folder: Path) -> None:
    """Time against error; splats × resolution; growth."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    folder.mkdir(parents=True, exist_ok=True)
    scenes = [row for row in rows if "image_max_error" in row]
    figure, axes = plt.subplots()
    for row in scenes:
        axes.loglog(row["forward_cpu_ms"] / row["control_cpu_ms"], row["image_max_error"], "o", label=row["workload"])
        axes.loglog(row["forward_cpu_ms"] / row["control_cpu_ms"], row["image_mean_error"], "x", color="gray")
    axes.set(xlabel="forward CPU time / control", ylabel="error against float64 (o maximum, x mean)")
    axes.legend()
    figure.savefig(folder / "time_error.png", dpi=120)
    for name, key in (("splats", "n"), ("pixels", "width"), ("overdraw", "covered_area")):
        chosen = [row for row in rows if row["workload"] == name]
        if not chosen:
            continue
        figure, axes = plt.subplots()
        x = [row[key] * row["height"] if key == "width" else row[key] for row in chosen]
        for kind in ("forward", "gradient"):
            axes.loglog(x, [row[f"{kind}_cpu_ms"] / row["control_cpu_ms"] for row in chosen], "o-", label=kind)
        axes.set(xlabel={"width": "pixels"}.get(key, key), ylabel="CPU time / control")
        axes.legend()
        figure.savefig(folder / f"growth_{name}.png", dpi=120)
    if scenes:
        figure, axes = plt.subplots()
        for row in scenes:
            size = row["width"] * row["height"]
            axes.scatter(row["n"], size, s=40 * row["gradient_cpu_ms"] / row["control_cpu_ms"])
            axes.annotate(f"{row['workload']}: {row['gradient_cpu_ms'] / row['control_cpu_ms']:.1f}", (row["n"], size))
        axes.set(xscale="log", yscale="log", xlabel="splats", ylabel="pixels", title="gradient CPU time / control")
        figure.savefig(folder / "splats_resolution.png", dpi=120)


def main() -> None:
    """Parse arguments, run, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--workloads", type=Path, required=True, help="folder of .npz files")
    parser.add_argument("--out", type=Path, required=True, help="JSON file to write: a list of rows")
    parser.add_argument("--plots", type=Path, help="folder for plots")
    parser.add_argument("--growth", action="store_true", help="also measure growth, from the largest workload")
    parser.add_argument("--tile-size", type=int, default=RenderConfig().tile_size)
    options = parser.parse_args()
    paths = sorted(options.workloads.glob("*.npz"), key=lambda path: path.stat().st_size)
    if not paths:
        raise SystemExit(f"--workloads: expected .npz files in {options.workloads}, found none")
    config = RenderConfig(tile_size=options.tile_size)
    rows = []
    for path in paths:
        rows.append(bench(path.stem, *load_workload(path), config=config, reference=True))
        print(json.dumps(rows[-1]), flush=True)
        options.out.write_text(json.dumps(rows, indent=1))
    if options.growth:
        rows += growth(paths[-1], config)
    for row in rows:
        row["jax"], row["device"] = jax.__version__, f"{jax.default_backend()} {platform.machine()}"
    options.out.write_text(json.dumps(rows, indent=1))
    if options.plots:
        plot(rows, options.plots)


if __name__ == "__main__":
    main()
