"""The renderer beside gsplat on one GPU: the same scenes, the same loss, wall time with the device waited for.

    python -m experiments.bench_gsplat --workloads FOLDER --out FILE.json

Workloads are those of experiments/bench_render.py; the largest is also drawn from again to a million splats at
1920×1080. gsplat and torch are no dependencies of this project: install them where this is to be run. Colours are
given, so that neither evaluates spherical harmonics; gsplat is called unpacked, in its classic mode. Both blend
without antialiasing and blur by 0.3 px²; opacities are cut at 0.99 here and at 0.999 there.
"""

import itertools
import json
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from experiments.bench_render import load_workload, subsample
from ltgs_jax.geometry import Camera
from ltgs_jax.render import RenderConfig, plan_render, render
from ltgs_jax.scene import Splats

_REPEATS = 20
_MANY = 1_000_000


@dataclass(frozen=True)
class Options:
    """What to measure."""

    workloads: Path
    out: Path
    tile_sizes: tuple[int, ...] = (RenderConfig().tile_size,)
    chunks: tuple[int, ...] = (RenderConfig().chunk,)
    blocks: tuple[int, ...] = (0,)
    """Tiles that advance together; 0: what the renderer takes for this device."""


def _milliseconds(call: Callable[[], object], wait: Callable[[object], object]) -> float:
    """Median wall time of a call, the device waited for, after three that warm up."""
    for _ in range(3):
        wait(call())
    times = []
    for _ in range(_REPEATS):
        start = time.perf_counter()
        wait(call())
        times.append(1e3 * (time.perf_counter() - start))
    return statistics.median(times)


def _ours(splats: Splats, camera: Camera, colors, background, target, config: RenderConfig) -> tuple[dict, np.ndarray]:
    start = time.perf_counter()
    plan = plan_render(splats, camera, config=config, slack=1)
    plan_s = time.perf_counter() - start

    def draw(splats, colors):
        return render(splats, camera, background=background, colors=colors, plan=plan, config=config).image

    def loss(splats, colors):
        return jnp.mean(jnp.abs(draw(splats, colors) - target))

    start = time.perf_counter()
    forward = jax.jit(draw).lower(splats, colors).compile()
    gradient = jax.jit(jax.value_and_grad(loss, argnums=(0, 1))).lower(splats, colors).compile()
    row = {
        "plan_s": plan_s,
        "compile_s": time.perf_counter() - start,
        "forward_ms": _milliseconds(lambda: forward(splats, colors), jax.block_until_ready),
        "gradient_ms": _milliseconds(lambda: gradient(splats, colors), jax.block_until_ready),
        "program_mb": gradient.memory_analysis().temp_size_in_bytes / 2**20,
    }
    return row, np.asarray(forward(splats, colors))


def _gsplat(splats: Splats, camera: Camera, colors, background, target) -> tuple[dict, np.ndarray]:
    import torch
    from gsplat import rasterization

    def tensor(x):
        return torch.tensor(np.asarray(x), dtype=torch.float32, device="cuda")

    lanes = [tensor(x) for x in (splats.means, splats.quats, splats.log_scales, splats.logit_opacities, colors)]
    lanes = [lane.requires_grad_() for lane in lanes]
    view, K = tensor(camera.cam_from_world.as_matrix())[None], tensor(camera.K)[None]
    behind, wanted = tensor(background)[None], tensor(target)

    def draw():
        means, quats, log_scales, logits, shades = lanes
        image, _, _ = rasterization(
            means,
            quats,
            log_scales.exp(),
            logits.sigmoid(),
            shades,
            view,
            K,
            camera.width,
            camera.height,
            near_plane=0.01,
            eps2d=0.3,
            packed=False,
            backgrounds=behind,
        )
        return image[0]

    def forward():
        with torch.no_grad():
            return draw()

    def gradient():
        return torch.autograd.grad((draw() - wanted).abs().mean(), lanes)

    def wait(_):
        torch.cuda.synchronize()

    torch.cuda.reset_peak_memory_stats()
    row = {"forward_ms": _milliseconds(forward, wait), "gradient_ms": _milliseconds(gradient, wait)}
    row["peak_mb"] = torch.cuda.max_memory_allocated() / 2**20
    return row, forward().cpu().numpy()


def main(options: Options) -> None:
    """Run, print, write."""
    paths = sorted(options.workloads.glob("*.npz"), key=lambda path: path.stat().st_size)
    if not paths:
        raise SystemExit(f"--workloads: expected .npz files in {options.workloads}, found none")
    scenes = {path.stem: load_workload(path) for path in paths}
    splats, camera, colors, background, _ = scenes[paths[-1].stem]
    many, many_colors = subsample(splats, colors, _MANY, (splats.count / _MANY) ** 0.5)
    wide = camera.resized(1920, 1080)
    scenes[f"{_MANY:,} splats"] = many, wide, many_colors, background, jnp.zeros((wide.height, wide.width, 3))
    rows = []
    for name, (splats, camera, colors, background, target) in scenes.items():
        print(name, splats.count, f"{camera.width}×{camera.height}", flush=True)
        theirs, image = None, None
        try:
            theirs, image = _gsplat(splats, camera, colors, background, target)
            print(f"  gsplat {json.dumps(theirs)}", flush=True)
        except ImportError as error:
            print(f"  gsplat left out: {error}", flush=True)
        for tile_size, chunk, block in itertools.product(options.tile_sizes, options.chunks, options.blocks):
            config = RenderConfig(tile_size=tile_size, chunk=chunk, tiles_per_block=block or None)
            ours, own_image = _ours(splats, camera, colors, background, target, config)
            row = {"workload": name, "n": splats.count, "width": camera.width, "height": camera.height}
            row |= {"tile_size": tile_size, "chunk": chunk, "tiles_per_block": block, "ltgs": ours, "gsplat": theirs}
            if image is not None:
                apart = np.abs(own_image - image)
                row |= {"apart_mean": float(apart.mean()), "apart_max": float(apart.max())}
            row |= {"jax": jax.__version__, "device": jax.devices()[0].device_kind}
            rows.append(row)
            print(f"  ltgs {json.dumps(row)}", flush=True)
            options.out.write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
