"""The bench of change detection measures what it says, on photographs of a few pixels."""

import dataclasses
import inspect
import json

import numpy as np
import pytest

from experiments import bench_change, bench_change_curves, bench_change_time
from experiments.bench_change import ScoreConfig, object_scores, score_table
from experiments.bench_change_curves import (
    DEMO,
    LIGHTS,
    Point,
    Stage,
    curve_points,
    halving_noise,
    pixel_scores,
    score_masks,
    score_views,
    set_stage,
)
from experiments.bench_change_plot import draw_curves
from experiments.engine import Run
from ltgs_jax.demo import make_capture, object_ids
from ltgs_jax.detect import fit_tone
from ltgs_jax.fit import InitialConfig, View, splats_from_points
from ltgs_jax.io import load_image, load_mask, read_capture, read_labels, read_ply, write_labels
from ltgs_jax.pipeline.looks import Eye, Observation
from tests.tiny_capture import write_tiny_capture

SMALL = dataclasses.replace(DEMO, scene="move", width=48, height=36, dense=4, update=2, test=1, points=200)


@pytest.fixture(scope="module")
def stage(tmp_path_factory) -> Stage:
    """A box that moved over a table; the initial scene is what the photographs were rendered from."""
    capture = read_capture(write_tiny_capture(tmp_path_factory.mktemp("tiny") / "c"))
    splats, eye = read_ply(capture.initial_ply), Eye()
    shots = [Observation(p.name, p.camera, load_image(p), load_mask(p)) for p in capture.at(1, "update")]
    true = [np.abs(eye.image(splats, shot.camera) - shot.image).max(axis=-1) > 0.1 for shot in shots]
    train = [View(p.camera, np.uint8(255 * load_image(p)), load_mask(p)) for p in capture.at(0, "train")]
    pairs = list(zip(shots, true, strict=True))
    return Stage(capture.visits, splats, train, pairs, pairs)


def test_the_captures_are_those_of_the_demo():
    made = {name: p.default for name, p in inspect.signature(make_capture).parameters.items() if name != "folder"}
    assert {name: getattr(DEMO, name) for name in made} == made
    assert ScoreConfig().overrides == (("fit.long.passes", 0),)


def test_ids_are_cast_as_the_capture_has_them(tmp_path):
    folder = make_capture(tmp_path / "c", scene="turnover", seed=3, width=48, height=36, dense=3, update=1, points=50)
    photograph = read_capture(folder).at(1, "update")[0]
    (now,), (before,) = (object_ids("turnover", 3, t, [photograph.camera]) for t in (1, 0))
    kept = read_labels(folder / "truth" / "masks" / "IMG_0001" / "000.png")
    assert (now == kept).mean() > 0.995  # rays through float32 poses
    assert (before != kept).mean() > 0.01


def test_noise_on_features_costs_matches_and_no_detection_is_no_score(stage):
    clean, noisy, blind = (score_masks(Point(**change), stage) for change in ({}, {"noise": 2.0}, {"sigmas": 1e4}))
    assert 0.6 < clean["f1"] <= 1
    assert noisy["matching_precision"] < 0.5 * clean["matching_precision"]
    assert blind["f1"] == blind["recall"] == 0
    assert np.isnan(blind["precision"])
    assert 0 < clean["seconds_image"] < 5


def test_other_light_is_worse_left_in(stage):
    out, left = (score_masks(Point(light="−1 stop", tone=tone), stage)["f1"] for tone in (True, False))
    assert out > left + 0.05


def test_the_stage_has_the_truth_of_the_capture(tmp_path, monkeypatch):
    def unfitted(config, problem, cache):
        return splats_from_points(problem.points, problem.colors, capacity=256, sh_degree=0), cache, {}

    monkeypatch.setattr(bench_change_curves, "initial_scene", unfitted)
    stage = set_stage(SMALL, InitialConfig(), tmp_path)
    assert (len(stage.used), len(stage.held)) == (2, 1)
    for shot, true in stage.used + stage.held:
        (path,) = tmp_path.glob(f"captures/*/truth/masks/{shot.name}")
        ids = read_labels(path)
        moved = [i for i in np.unique(ids) if i > 0 and true[ids == i].mean() > 0.9]
        assert len(moved) == 1  # one thing moves; it is true where it is, and where it was
        assert true.sum() > 1.3 * (ids == moved[0]).sum()


def test_the_light_of_the_bench_is_taken_out():
    image = np.random.default_rng(0).uniform(0.1, 0.6, (40, 60, 3)).astype(np.float32)
    for name, light in LIGHTS.items():
        lit = light(image).astype(np.float32)
        left = np.abs(fit_tone(lit, image, np.ones(image.shape[:2], bool))(lit) - image).mean()
        assert left < (0.012 if "stop" in name else 0.03), name  # below 0.03 it is taken for the same light
        assert np.abs(lit - image).max() > 0.02 or name == "as taken", name


def _written(folder, out, found: list[np.ndarray], true: list[np.ndarray], objects: int) -> None:
    """A truth of three things, of which 1 and 2 move at every visit, and what a run would have left."""
    for visit, (a, b) in enumerate(zip(found, true, strict=True), start=1):
        write_labels(out / "masks" / f"V{visit}" / "0.png", a)
        write_labels(folder / "truth" / "masks" / f"V{visit}" / "0.png", b)
    poses = [{n: (np.eye(4) + t * (n != "c")).tolist() for n in "abc"} for t in range(len(found) + 1)]
    truth = {"ids": {"a": 1, "b": 2, "c": 3}, "extents": {n: [1, 1, 1] for n in "abc"}, "times": poses}
    (folder / "truth" / "objects.json").write_text(json.dumps(truth))
    state = {"visit": 1, "event": "moved", "visible": True, "confidence": 1.0, "inliers": 1, "residual": 0.0}
    state |= {"world_from_template": {"wxyz": [1, 0, 0, 0], "xyz": [0, 0, 0]}, "ambiguous_axis": None}
    thing = {"source_visit": 0, "splats": 1, "center": [0, 0, 0], "size": 1.0, "states": [state]}
    tracks = {"version": 1, "visits": ["V0", *(f"V{t + 1}" for t in range(len(found)))], "photographs": []}
    tracks["objects"] = [{"id": i + 1, **thing} for i in range(objects)]
    (out / "tracks.json").write_text(json.dumps(tracks))


def test_identities_and_ious_are_those_of_the_definition(tmp_path):
    true = np.zeros((3, 20, 40), np.int32)
    true[:, 2:12, 2:12], true[:, 2:12, 20:30], true[:, 14:18, 2:12] = 1, 2, 3
    found = np.where(true == 3, 0, 10 * true)  # the third thing never moves: it is nobody's to find
    found[0, 2:7, 2:12] = 0  # half of an object
    found[2][true[2] == 2] = 30  # a stranger in its place
    _written(tmp_path / "c", tmp_path / "o", list(found), list(true), 3)
    row = object_scores(tmp_path / "o", tmp_path / "c")
    assert row["objects"] == 3
    assert row["object_iou"] == pytest.approx((250 / 300 + 200 / 300) / 2)
    assert row["identities_right"] == pytest.approx(5 / 6)


def test_a_table_has_a_line_per_run_means_and_failures():
    configs = [ScoreConfig(dataclasses.replace(DEMO, scene=s, seed=i)) for s in ("move", "light") for i in (0, 1)]
    runs = [Run("experiments.bench_change:run_scores", config) for config in configs]
    rows = {run.name: {"status": "done", "event_f1": i / 2, "objects": 3} for i, run in enumerate(runs[:2])}
    rows[runs[2].name] = {"status": "failed", "reason": "ValueError: no"}
    text = score_table(runs, rows)
    assert "| move, mean | 0.25 |" in text
    assert "| light 0: ValueError: no |" in text
    assert "| light 1: missing |" in text


def test_scores_of_masks():
    found, true = np.zeros((2, 4, 4), bool), np.zeros((2, 4, 4), bool)
    found[0, :2], true[0, :1], true[1, 0] = True, True, True
    assert pixel_scores(list(found), list(true)) == {"f1": 0.5, "precision": 0.5, "recall": 0.5}
    rows = [(x, {"matching_precision": p}) for x, p in ((0.0, 0.8), (1.0, 0.5), (2.0, 0.3))]
    assert halving_noise(rows) == pytest.approx(1.5)
    assert np.isnan(halving_noise(rows[:2]))


def test_the_picture_is_as_wide_as_it_says(tmp_path):
    row = {"f1": 0.5, "precision": 0.4, "recall": 0.6, "matching_precision": 0.5, "seconds_image": 0.1}
    points = curve_points(Point(), "")
    assert "XFeat" not in [value for value, _ in points["front end"]]
    assert "XFeat" in [value for value, _ in curve_points(Point(), "x.onnx")["front end"]]
    draw_curves({name: [(value, row) for value, _ in runs] for name, runs in points.items()}, tmp_path / "c.png")
    assert int.from_bytes((tmp_path / "c.png").read_bytes()[16:20], "big") == 900


def test_memory_and_time_are_measured():
    block = bench_change_time.peak_bytes(lambda: np.ones(8 << 20)) - bench_change_time.peak_bytes(lambda: None)
    assert 60e6 < block < 100e6
    parts = bench_change_time.time_parts(64, 48, 200)
    assert 0 < parts["features of both images"]["seconds_cpu"] <= parts["all"]["seconds_cpu"] * 1.5


def test_no_point_is_started_after_the_deadline(tmp_path):
    text = bench_change.curves(bench_change.Curves(tmp_path, only=("threshold",), minutes=-1.0))
    assert "XFeat left out" in text
    assert not list((tmp_path / "runs").glob("*/metrics.json"))


@pytest.mark.slow
def test_what_left_and_what_came_are_explained_together(stage):
    row = score_views(Point(views=3), stage)
    assert row["objects"] >= 1
    assert row["f1"] > 0.6
