"""The renderer beside gsplat on one GPU: the same scenes, the same loss, wall time with the device waited for.

    python -m experiments.bench_gsplat --workloads FOLDER --out FILE.json

Workloads are those of experiments/bench_render.py; the largest is also drawn from again to a million splats at
1920×1080. gsplat and torch are no dependencies of this project: install them where this is to be run. Colours are
given, so that neither evaluates spherical harmonics; gsplat is called unpacked, in its classic mode. Both blend
without antialiasing and blur by 0.3 px²; opacities are cut at 0.99 here and at 0.999 there.
"""

import itertools
import json
from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from experiments.bench_render import bench, load_workload, measure, subsample
from ltgs_jax.geometry import Camera
from ltgs_jax.render import RenderConfig, render
from ltgs_jax.scene import Splats

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
            draw()
        torch.cuda.synchronize()

    def gradient():
        torch.autograd.grad((draw() - wanted).abs().mean(), lanes)
        torch.cuda.synchronize()

    torch.cuda.reset_peak_memory_stats()
    gradient()
    row = {"forward_wall_ms": measure(forward)[0], "gradient_wall_ms": measure(gradient)[0]}
    row["peak_mb"] = torch.cuda.max_memory_allocated() / 2**20
    return row, draw().detach().cpu().numpy()


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
            row = bench(name, splats, camera, colors, background, target, config=config, reference=False)
            row |= {"tile_size": tile_size, "chunk": chunk, "tiles_per_block": block, "gsplat": theirs}
            if image is not None:
                own = render(splats, camera, background=background, colors=colors, config=config).image
                apart = np.abs(np.asarray(own) - image)
                row |= {"apart_mean": float(apart.mean()), "apart_max": float(apart.max())}
            row |= {"jax": jax.__version__, "device": jax.devices()[0].device_kind}
            rows.append(row)
            print(f"  ltgs {json.dumps(row)}", flush=True)
            options.out.write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
