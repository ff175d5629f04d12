"""The curves, the stability page and the gate measure what they say."""

import json

import numpy as np
import pytest

from experiments import bench, stability
from experiments.curves import RegistrationPoint, RendererPoint, curve_runs, registration_problem, run_renderer
from experiments.stability import Hard, run_angle, run_edges, run_scene, stability_runs


def test_registration_problems_have_the_answer_that_they_name():
    src, dst, rotmat, xyz = registration_problem(3, 200, 0.9)
    residual = np.linalg.norm(src @ rotmat.T + xyz - dst, axis=1)
    assert np.sum(residual < 0.03) == pytest.approx(20, abs=8)
    assert np.linalg.det(rotmat) == pytest.approx(1)


def test_error_of_float32_grows_with_the_distance_from_the_origin(tmp_path):
    near, far = (run_scene(Hard("distance from the origin", value), tmp_path, tmp_path) for value in (0.0, 1e4))
    assert near["overflow"] == far["overflow"] == 0
    assert near["of image: largest error"] < 1e-3
    assert far["of image: mean error"] > 10 * near["of image: mean error"]
    assert near["of gradient: worst relative error"] < 1e-2


def test_rotations_near_pi_and_the_edges_stay_finite(tmp_path):
    row = run_angle(Hard("angle near π", 1e-4), tmp_path, tmp_path)
    assert row["of exp: radians"] < 1e-5
    assert row["of Jacobian: entries not finite"] == 0
    cases = [run_edges(Hard("gradients at the edges", float(i)), tmp_path, tmp_path) for i in range(9)]
    assert len({case["of what"] for case in cases}) == 9
    assert [case["of image: not finite"] for case in cases] == [0] * 9
    assert [case["of gradient: not finite"] for case in cases] == [0] * 9


@pytest.mark.slow
def test_float64_is_nearer_to_the_reference_than_float32(tmp_path):
    single, double = (
        run_renderer(RendererPoint(double=d, splats=300, width=48, height=36), tmp_path, tmp_path)
        for d in (False, True)
    )
    assert double["error"] < 1e-9 < single["error"] < 1e-3


def test_every_curve_has_several_settings():
    curves = [name.partition(": ")[0] for name in curve_runs(1)]
    assert {curve: curves.count(curve) >= 4 for curve in curves} == dict.fromkeys(curves, True)
    assert len(stability_runs(1)) == len({run.name for group in stability_runs(1).values() for run in group})
    assert RegistrationPoint().points == 32


def test_the_gate_tells_worse_from_better():
    base = {"error": 1.0, "time_ratio": 2.0}

    def one() -> float:
        return 1.0

    fine = bench.Measured(1.01, lambda: 2.5)
    assert bench.compare("a", fine, base, one)[1:] == ([], [])
    row, problems, slow = bench.compare("a", bench.Measured(1.03, lambda: 2.5), base, one)
    assert row == {"error": 1.03, "time_ratio": 2.5}
    assert (problems, slow) == (["a: error 1.03, baseline 1"], [])
    assert len(bench.compare("a", bench.Measured(float("nan"), lambda: 2.5), base, one)[1]) == 1
    times = iter((9.0, 2.6))  # a busy moment is no slowdown
    assert bench.compare("a", bench.Measured(1.0, lambda: next(times)), base, one)[1:] == ([], [])
    assert len(bench.compare("a", bench.Measured(1.0, lambda: 9.0), base, one)[2]) == 1
    assert bench.compare("a", fine, None, one)[1] == ["a: is not in the baseline"]


def test_the_committed_baseline_has_every_measurement():
    assert set(json.loads(bench.BASELINE.read_text())) == set(bench.ALL)
    assert set(bench.QUICK) <= set(bench.ALL)
    assert stability.SCENES.keys().isdisjoint(stability.OTHERS)
