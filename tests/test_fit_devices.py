"""A fit's batch dealt out over devices gives what one device gives: each count in a process of its own."""

import json
import os
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest
from test_fit import _camera, _moved_chronology, _view

from ltgs_jax.fit import LongConfig, VisitView, fit_chronology
from ltgs_jax.fit.initial import _draw
from ltgs_jax.scene import compose

_PROGRAM = """
import json
import jax, numpy as np
from test_fit import InitialConfig, LongConfig, VisitView, _camera, _cloud, _moved_chronology, _view
from test_fit import compose, fit_chronology, fit_initial, splats_from_points
truth = _cloud(4)
views = [_view(truth, _camera(x)) for x in (-0.3, -0.1, 0.1, 0.3)]
start = splats_from_points(np.asarray(truth.means), np.full((40, 3), 0.5), capacity=48, sh_degree=0)
config = InitialConfig(steps=48, batch=2, max_splats=48, sh_degree=0, coarse_fraction=0.0, grow_every=16)
said = []
first = fit_initial(start, views, key=jax.random.key(0), config=config, progress=lambda i, n, text: said.append(text))
truth, off = _moved_chronology(0.06)
views = [VisitView(_view(compose(truth, t), _camera(x)), t) for t in (0, 1) for x in (-0.3, 0.0, 0.3)]
config = LongConfig(passes=16, batch=2, background_rate=0.0, translation_rate=0.02, rotation_rate=2e-3)
fitted, losses = fit_chronology(off, views, key=jax.random.key(0), config=config)
arrays = [*jax.tree.leaves(first.splats), *jax.tree.leaves(fitted)]
arrays = [np.asarray(a, np.float64).ravel().tolist() for a in arrays if np.asarray(a).dtype.kind == "f"]
print(json.dumps({"said": said[0], "initial": first.losses.tolist(), "long": losses.tolist(), "arrays": arrays}))
"""


def _fitted(devices: int) -> dict:
    folder = Path(__file__).parent
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count={devices}"
    paths = os.pathsep.join([str(folder), str(folder.parent)])
    environment = os.environ | {"XLA_FLAGS": flags, "PYTHONPATH": paths}
    run = subprocess.run([sys.executable, "-c", _PROGRAM], env=environment, capture_output=True, text=True, timeout=600)
    assert run.returncode == 0, run.stderr
    return json.loads(run.stdout.splitlines()[-1])


@pytest.mark.slow
def test_a_batch_over_two_devices_is_fitted_as_on_one():
    one, two = _fitted(1), _fitted(2)
    assert one["said"] == "2 photographs a step, on 1 of 1 devices"
    assert two["said"] == "2 photographs a step, on 2 of 2 devices"
    for kind in ("initial", "long"):
        losses = np.asarray(one[kind])
        assert losses[-8:].mean() < losses[:8].mean()
        np.testing.assert_allclose(two[kind], losses, rtol=1e-5, atol=1e-7)
    for a, b in zip(one["arrays"], two["arrays"], strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-3, atol=5e-4)  # Adam makes more of the order of sums than they are


@pytest.mark.slow
def test_a_batch_of_more_windows_than_there_are_still_takes_a_step():
    truth, off = _moved_chronology(0.06)
    views = [VisitView(_view(compose(truth, 1), _camera(0.0)), 1)]
    _, losses = fit_chronology(off, views, key=jax.random.key(0), config=LongConfig(passes=1, batch=4))
    assert len(losses) == 1


def test_a_batch_is_of_one_size_and_every_photograph_has_its_turn():
    sizes = [(8, 8), (9, 9), (8, 8), (9, 9), (8, 8), (9, 9)]
    order, rng = [], np.random.default_rng(0)
    drawn = [_draw(order, sizes, 2, rng) for _ in range(60)]
    assert all(len({sizes[i] for i in batch}) == 1 for batch in drawn)
    counts = np.bincount(np.concatenate(drawn), minlength=6)
    assert counts.sum() == 120
    assert counts.min() >= 18
