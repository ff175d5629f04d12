"""Four hundred large photographs are fitted within eight gigabytes: measured in a process of its own."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

_PROGRAM = """
import json, resource
import jax, jax.numpy as jnp, numpy as np
from ltgs_jax.fit import Budget, InitialConfig, StreamedView, View, fit_initial, splats_from_points
from ltgs_jax.geometry import SE3, Camera
from ltgs_jax.pipeline.config import IoConfig

WIDTH, HEIGHT, COUNT = 1600, 1200, 400
budget, decoded = Budget(IoConfig().photograph_bytes), [0]
K = jnp.asarray([[1400.0, 0, WIDTH / 2], [0, 1400.0, HEIGHT / 2], [0, 0, 1]])

def load(i, camera):
    decoded[0] += 1
    row = np.random.default_rng(i).integers(0, 256, (1, WIDTH, 3), dtype=np.uint8)
    return View(camera, np.repeat(row, HEIGHT, axis=0), np.ones((HEIGHT, WIDTH), bool))

views = []
for i in range(COUNT):
    pose = SE3(jnp.asarray([1.0, 0, 0, 0]), jnp.asarray([0.002 * i - 0.4, 0, 3.0]))
    camera = Camera(pose, K, WIDTH, HEIGHT)
    view = StreamedView(camera, lambda i=i, c=camera: load(i, c), budget)
    view.check()
    views.append(view)
points = np.random.default_rng(0).uniform([-1.5, -1, -0.5], [1.5, 1, 0.5], (20_000, 3))
config = InitialConfig(steps=int(STEPS), max_splats=30_000)
start = splats_from_points(points, np.full((20_000, 3), 0.5), capacity=config.max_splats, sh_degree=config.sh_degree)
losses = fit_initial(start, views, key=jax.random.key(0), config=config).losses
peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
print(json.dumps({"peak": peak, "losses": losses.tolist(), "decoded": decoded[0]}))
"""


@pytest.mark.slow
def test_four_hundred_large_photographs_fit_into_eight_gigabytes():
    done = subprocess.run(
        [sys.executable, "-c", _PROGRAM.replace("STEPS", "6")],
        capture_output=True, text=True, cwd=Path(__file__).parents[1], check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-2000:]
    found = json.loads(done.stdout.splitlines()[-1])
    assert all(0 < loss < 2 for loss in found["losses"])
    assert found["decoded"] >= 400
    assert found["peak"] < 8e9, f"{found['peak'] / 1e9:.2f} GB"
