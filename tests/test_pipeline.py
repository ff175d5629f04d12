"""The main job on a small built-in capture: what it leaves, resume, and refusals."""

import importlib
import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tiny_capture import write_tiny_capture

from ltgs_jax import pipeline
from ltgs_jax.demo import make_capture
from ltgs_jax.fit.mend import Mended
from ltgs_jax.geometry import SE3, Camera
from ltgs_jax.io import InputError, load_chronology, read_capture, read_json, read_ply, read_tracks
from ltgs_jax.localize import Localization, PhotographStatus
from ltgs_jax.pipeline import cameras
from ltgs_jax.pipeline.cameras import Run, hold_against_renders
from ltgs_jax.pipeline.outputs import read_cameras
from ltgs_jax.pipeline.store import Store, digest
from ltgs_jax.pipeline.views import load_views
from ltgs_jax.render import render
from ltgs_jax.scene import Splats, Template, compose, concatenate_splats

_TINY = pipeline.PRESETS["tiny"]
CONFIG = replace(_TINY, fit=replace(_TINY.fit, long=replace(_TINY.fit.long, passes=2)))


class Quiet:
    """A reporter that remembers."""

    def __init__(self) -> None:
        self.lines: list[str] = []

    def stage(self, name: str) -> None:
        self.lines.append(name)

    def step(self, i: int, n: int, text: str = "") -> None:
        del i, n, text

    def note(self, text: str) -> None:
        self.lines.append(text)

    def warn(self, text: str) -> None:
        self.lines.append(f"warning: {text}")


@pytest.fixture(scope="module")
def capture(tmp_path_factory) -> Path:
    folder = make_capture(
        tmp_path_factory.mktemp("pipeline") / "capture",
        scene="move",
        seed=1,
        width=112,
        height=84,
        dense=14,
        update=3,
        test=1,
        points=1500,
    )
    for visit in ("IMG_0002", "IMG_0003"):  # two visits tell what four would
        shutil.rmtree(folder / "images" / visit)
    return folder


@pytest.fixture(scope="module")
def run(capture) -> Path:
    out = capture.parent / "out"
    pipeline.update(capture, out, config=CONFIG, progress=Quiet())
    return out


def test_every_file_of_the_contract_is_there(run, capture):
    visits = read_tracks(run / "tracks.json")["visits"]
    for name in ("config.json", "env.json", "stages.json", "chronology.json", "chronology.safetensors", "metrics.json"):
        assert (run / name).is_file(), name
    for t in range(len(visits)):
        assert (run / "splats" / f"{capture.name}_{t:04d}.ply").is_file()
    assert not (run / ".running").exists()
    stages = read_json(run / "stages.json", list)
    assert [row["stage"] for row in stages][:3] == ["localize", "initial", "align"]
    assert all(row["status"] == "done" for row in stages)


def test_what_was_known_well_is_not_mended_and_the_stage_says_so(run):
    counts = next(row for row in read_json(run / "stages.json", list) if row["stage"] == "mend")["counts"]
    assert 0 <= counts["unknown"] < CONFIG.fit.mend.share
    assert counts["steps"] == 0


def test_a_mended_scene_tells_the_visits_again_and_resumes(run, capture, tmp_path, monkeypatch):
    update = importlib.import_module("ltgs_jax.pipeline.update")
    mended = []

    def mend(chronology, views, **_):
        background = chronology.background
        darker = eqx.tree_at(lambda s: s.sh, background, background.sh - 1e-3)
        mended.append(len(views))
        return Mended(eqx.tree_at(lambda c: c.background, chronology, darker), (0.2, 0.1), (0.2, 0.1), np.ones(1), True)

    monkeypatch.setattr(update, "mend_background", mend)
    out, progress = tmp_path / "out", Quiet()
    shutil.copytree(run, out)
    config = replace(CONFIG, fit=replace(CONFIG.fit, mend=replace(CONFIG.fit.mend, share=0.0)))
    chronology = pipeline.update(capture, out, config=config, progress=progress)
    assert "visit_001: taken from disk" in progress.lines and len(mended) == 2
    stages = [row["stage"] for row in read_json(out / "stages.json", list)]
    told = ["visit_001", "fit", "mend"]
    assert stages[3:] == [*told, *(f"again_{name}" for name in ("initial", *told)), "ledger", "outputs", "evaluate"]
    first = read_ply(run / "splats" / f"{capture.name}_0000.ply")
    assert compose(chronology, 0).sh.mean() < first.sh.mean() - 1.5e-3  # mended twice
    assert [item["states"][0]["event"] for item in read_tracks(out / "tracks.json")["objects"]] == ["moved"]
    progress = Quiet()
    pipeline.update(capture, out, config=config, progress=progress)
    assert {"mend: taken from disk", "again_visit_001: taken from disk", "again_mend: taken from disk"} <= set(
        progress.lines
    )
    once = replace(config, fit=replace(config.fit, mend=replace(config.fit.mend, again=False)))
    pipeline.update(capture, tmp_path / "once", config=once, progress=Quiet())
    assert not list((tmp_path / "once" / "stages").glob("again_*"))


def test_exported_visit_renders_like_the_composed_one(run, capture):
    chronology = load_chronology(run)
    _, cameras = read_cameras(run)
    _, _, camera = next(entry for name, entry in cameras.items() if name.startswith(chronology.visits[1]))
    for t in range(len(chronology.visits)):
        exported = render(read_ply(run / "splats" / f"{capture.name}_{t:04d}.ply"), camera).image
        composed = render(compose(chronology, t), camera).image
        np.testing.assert_allclose(exported, composed, atol=1e-5)


def test_masks_and_renders_have_the_photographs_sizes(run, capture):
    for photograph in read_json(run / "report.json")["photographs"]:
        image = cv2.imread(str(capture / "images" / photograph["name"]))
        rendered = cv2.imread(str(run / photograph["render_path"]))
        assert rendered.shape == image.shape
        if photograph["role"] == "update":
            mask = cv2.imread(str(run / photograph["mask_path"]), cv2.IMREAD_UNCHANGED)
            assert mask.shape == image.shape[:2]


def test_scores_cover_later_visits_and_the_truth(run):
    rows = read_json(run / "metrics.json", list)
    keys = {row["key"] for row in rows}
    assert {"psnr", "ssim", "flip", "event_f1", "mask_iou", "mask_f1"} <= keys
    assert all(np.isfinite(row["value"]) for row in rows)


def test_the_ledger_says_what_each_thing_cost_and_bought(run):
    chronology = load_chronology(run)
    rows = next(row for row in read_json(run / "stages.json", list) if row["stage"] == "ledger")["counts"]["ledger"]
    moved = [row for row in rows if row["what"].endswith(("moved", "added"))]
    assert moved and all(row["gain_db"] > 0.1 for row in moved)
    assert all(row["bytes"] == 4 * row["parameters"] for row in rows)
    per_splat = sum(np.prod(leaf.shape[1:], dtype=int) for leaf in jax.tree.leaves(chronology.background))
    late = int((np.asarray(chronology.since) > 0).sum())
    assert sum(row["parameters"] for row in rows if row["what"] == "ground") == late * per_splat
    for row in rows:
        if row["what"].endswith("moved"):
            assert row["parameters"] == 7  # a pose and nothing else
            assert row["evidence"] in ("search", "matches")
    assert all(row["evidence"] is None for row in rows if row["what"].endswith(("removed", "ground", "shadows")))


def test_a_second_run_resumes_and_changes_nothing(run, capture):
    before = (run / "chronology.safetensors").read_bytes()
    progress = Quiet()
    pipeline.update(capture, run, config=CONFIG, progress=progress)
    assert "initial: taken from disk" in progress.lines
    assert "fit: taken from disk" in progress.lines
    assert (run / "chronology.safetensors").read_bytes() == before


def _psnr(run):
    rows = read_json(run / "metrics.json", list)
    return {(row["visit"], row["region"]): row["value"] for row in rows if row["key"] == "psnr"}


def _fit_steps(run):
    return next(row for row in read_json(run / "stages.json", list) if row["stage"] == "fit")["counts"]["steps"]


@pytest.mark.slow  # four runs, two of them with all passes
def test_a_visit_that_comes_later_costs_what_it_changes_and_ends_as_good_as_all_at_once(tmp_path):
    config = replace(CONFIG, fit=replace(CONFIG.fit, long=_TINY.fit.long))  # enough passes for what is told apart
    capture, aside = write_tiny_capture(tmp_path / "capture", again=True), tmp_path / "t2"
    (capture / "images" / "t2").rename(aside)
    pipeline.update(capture, tmp_path / "grown", config=config, progress=Quiet())
    known = read_tracks(tmp_path / "grown" / "tracks.json")["objects"]
    before = _fit_steps(tmp_path / "grown")
    aside.rename(capture / "images" / "t2")
    progress = Quiet()
    pipeline.update(capture, tmp_path / "grown", config=config, progress=progress)
    assert {"initial: taken from disk", "visit_001: taken from disk"} <= set(progress.lines)
    assert "visit_002: taken from disk" not in progress.lines and "fit: taken from disk" not in progress.lines
    assert "going on from the fit of the visits before t2" in progress.lines
    objects = read_tracks(tmp_path / "grown" / "tracks.json")["objects"]
    assert [[state["event"] for state in item["states"]] for item in known] == [["moved"]]
    assert [state["event"] for state in objects[0]["states"]] == ["moved", "moved"]
    pipeline.update(capture, tmp_path / "at_once", config=config, progress=Quiet())
    grown, at_once = _psnr(tmp_path / "grown"), _psnr(tmp_path / "at_once")
    assert grown.keys() == at_once.keys()
    apart = {key: round(grown[key] - at_once[key], 3) for key in grown}
    assert min(value for (_, region), value in apart.items() if region == "full") > -0.2, apart
    assert min(apart.values()) > -0.5, apart
    assert before + _fit_steps(tmp_path / "grown") <= _fit_steps(tmp_path / "at_once") + 1
    visits = [name for name in ("grown", "at_once") if (tmp_path / name / "stages" / "visit_002.safetensors").exists()]
    first, second = ((tmp_path / name / "stages" / "visit_002.safetensors").read_bytes() for name in visits)
    assert first[-1000:] == second[-1000:]  # explained alike: the arrays, after a header with times
    progress = Quiet()
    pipeline.update(capture, tmp_path / "grown", config=config, progress=progress)
    assert "fit: taken from disk" in progress.lines


def test_a_stage_cut_short_is_done_again_with_the_same_result(run, capture, tmp_path):
    copy = tmp_path / "copy"
    shutil.copytree(run, copy)
    path = copy / "stages" / "fit.safetensors"
    path.write_bytes(path.read_bytes()[:-100])
    progress = Quiet()
    pipeline.update(capture, copy, config=CONFIG, progress=progress)
    assert "fit: taken from disk" not in progress.lines
    assert (copy / "chronology.safetensors").read_bytes() == (run / "chronology.safetensors").read_bytes()


def test_renders_of_a_finished_run(run, capture, tmp_path):
    pipeline.render_visit(run, 1, None, True, tmp_path / "all")
    assert len(list((tmp_path / "all").rglob("*.png"))) == 2
    with pytest.raises(InputError, match=r"--camera nowhere\.png"):
        pipeline.render_visit(run, 1, "nowhere.png", False, tmp_path)


def test_an_option_that_no_run_could_go_with_is_named(capture, tmp_path):
    for change, name in (
        (replace(CONFIG, io=replace(CONFIG.io, max_side=3)), "--io.max-side 3: expected at least 16"),
        (replace(CONFIG, detect=replace(CONFIG.detect, gamma=float("nan"))), "--detect.gamma nan"),
        (replace(CONFIG, fit=replace(CONFIG.fit, initial=replace(CONFIG.fit.initial, sh_degree=4))), "0 to 3"),
    ):
        with pytest.raises(InputError, match=name):
            pipeline.update(capture, tmp_path / "out", config=change, progress=Quiet())
    with pytest.raises(InputError, match="--seed -1"):
        pipeline.update(capture, tmp_path / "out", config=CONFIG, seed=-1, progress=Quiet())
    assert not (tmp_path / "out").exists()


def test_a_missing_capture_is_refused(tmp_path):
    with pytest.raises(InputError, match="no such folder"):
        pipeline.update(tmp_path / "nothing", tmp_path / "out", config=CONFIG, progress=Quiet())
    assert not (tmp_path / "out").exists()


def test_store_computes_once_per_key(tmp_path):
    calls = []

    def compute():
        calls.append(1)
        return {"a": np.arange(3)}, {"counts": {"n": 3}}

    for key in ("x", "x", "y"):
        arrays, notes = Store(tmp_path, Quiet()).run("stage", key, compute)
        np.testing.assert_array_equal(arrays["a"], np.arange(3))
        assert notes["counts"] == {"n": 3}
    assert len(calls) == 2
    rows = json.loads((tmp_path / "stages.json").read_text())
    assert rows[0]["stage"] == "stage"


def test_digest_tells_contents_apart():
    assert digest(np.zeros(2)) != digest(np.zeros(3))
    assert digest(jnp.zeros(2)) == digest(jnp.zeros(2))
    assert digest(CONFIG) != digest(pipeline.PRESETS["fast"])


def test_a_damaged_photograph_is_named_and_the_rest_goes_on(capture, tmp_path):
    copy = tmp_path / "capture"
    shutil.copytree(capture, copy)
    photographs = sorted((copy / "images" / "IMG_0001").glob("*.png"))
    whole = read_capture(copy)
    found = Localization({p.name: p.camera for p in whole.photographs}, {}, ())
    run = Run(whole, found, CONFIG, 0)
    used = run.posed(1, "update")
    damaged = next(path for path in photographs if used[0].name.endswith(path.name))
    content = bytearray(damaged.read_bytes())
    content[len(content) // 2 : len(content) // 2 + 200] = bytes(200)
    damaged.write_bytes(content)
    progress = Quiet()
    views = load_views(run, used, progress)
    assert [p.name for p, _ in views] == [p.name for p in used[1:]]
    assert any(used[0].name in line and line.startswith("warning") for line in progress.lines)
    with pytest.raises(InputError, match="none of the photographs"):
        load_views(run, used[:1], progress)


def test_whose_pose_was_found_on_renders_is_remembered(capture, tmp_path, monkeypatch):
    whole = read_capture(capture)
    placed = {p.name: p.camera for p in whole.photographs}
    rough, lost, *_ = [p.name for p in whole.at(1, "update")]
    off = SE3(placed[rough].cam_from_world.quat, placed[rough].cam_from_world.xyz + 0.02)
    before = {**placed, rough: replace(placed[rough], cam_from_world=off)}
    del before[lost]
    run = Run(whole, Localization(before, {}, ()), CONFIG, 0)
    status = tuple(PhotographStatus(name, "localized", 9, None, None) for name in (rough, lost))
    monkeypatch.setattr(cameras, "align_later", lambda *_, **__: Localization(placed, {}, status))
    for _ in ("computed", "taken from disk"):
        progress = Quiet()
        held = hold_against_renders(Store(tmp_path, progress), "key", run, None, None, progress)
        assert held.on_renders == {rough, lost}
        assert [rough in line or lost in line for line in progress.lines if line.startswith("warning")] == [True, True]


@pytest.mark.parametrize("strange", [1, 3])
def test_a_photograph_of_something_else_is_left_out_and_said(run, capture, tmp_path, strange):
    copy = tmp_path / "capture"
    shutil.copytree(capture, copy)
    used = read_capture(copy).at(1, "update")
    for photograph in used[strange:]:  # the others show that nothing changed
        shutil.copy(run / "renders_initial" / photograph.name, photograph.path)
    for photograph in used[:strange]:
        noise = np.random.default_rng(0).integers(0, 256, (84, 112, 3)).astype(np.uint8)
        cv2.imwrite(str(photograph.path), cv2.GaussianBlur(noise, (0, 0), 2))
    config = replace(CONFIG, fit=replace(CONFIG.fit, long=replace(CONFIG.fit.long, passes=0)))
    progress = Quiet()
    found = pipeline.update(copy, tmp_path / "out", config=config, initial=run / "initial.ply", progress=progress)
    told = {p["name"]: p for p in read_json(tmp_path / "out" / "tracks.json")["photographs"]}
    for photograph in used:
        left_out = photograph in used[:strange]
        assert (told[photograph.name]["status"] == "rejected") == left_out
        assert any(f"warning: {photograph.name}: left out" in line for line in progress.lines) == left_out
    assert not found.templates
    silent = any("none of its photographs tells anything" in line for line in progress.lines)
    assert silent == (strange == len(used))


def test_shreds_are_no_shape_to_hold_against_a_known_object():
    from types import SimpleNamespace

    from ltgs_jax.pipeline.arrivals import _same_shape

    box, other = np.zeros((40, 40), bool), np.zeros((40, 40), bool)
    box[5:25, 5:25] = True
    other[5:25, 15:35] = True
    shreds = np.zeros((40, 40), bool)
    shreds[::3, ::3] = True
    crop = SimpleNamespace(valid=np.ones((2, 40, 40), bool))

    def shape(*new: np.ndarray) -> float:
        return _same_shape(np.stack([box, box]), SimpleNamespace(outlines=np.stack(new)), crop)

    assert shape(box, box) == 1
    assert np.isclose(shape(box, other), 1 / 3)
    assert shape(box, shreds) == 1
    assert shape(shreds, shreds) == 1
    assert np.isclose(shape(shreds, other), 1 / 3)


def test_known_objects_side_by_side_have_the_shape_of_one_change():
    from types import SimpleNamespace

    from ltgs_jax.pipeline import Config
    from ltgs_jax.pipeline.arrivals import _shape_beside
    from ltgs_jax.template import Placement

    left, right = np.zeros((2, 40, 40), bool), np.zeros((2, 40, 40), bool)
    left[:, 5:25, 2:20] = True
    right[:, 5:25, 20:38] = True
    crop = SimpleNamespace(valid=np.ones((2, 40, 40), bool))
    new = SimpleNamespace(outlines=left | right)

    def found(outlines, gain: float = 0.3) -> Placement:
        return Placement(SE3.identity(), 0.1, gain, overlap=1.0, likeness=0.7, recall=0.5, outlines=outlines)

    def shape(*others: Placement) -> float:
        return _shape_beside(found(left), others, new, crop, Config())

    assert shape() == 0.5
    assert shape(found(right)) == 1
    assert shape(found(left | right)) == 0.5  # it lies upon the first
    assert shape(found(right, gain=0.01)) == 0.5  # it is no evidence itself


def test_a_thing_stands_on_its_surface_and_neither_floats_nor_clings():
    from ltgs_jax.pipeline.arrivals import _stands
    from ltgs_jax.pipeline.state import State
    from ltgs_jax.template import Support

    rng = np.random.default_rng(5)

    def box(count: int, low: list[float], high: list[float]) -> Splats:
        means = rng.uniform(low, high, (count, 3)).astype(np.float32)
        quats = np.tile(np.float32([1, 0, 0, 0]), (count, 1))
        scales = np.full((count, 3), np.log(0.02), np.float32)
        return Splats(means, quats, scales, np.full(count, 3, np.float32), np.zeros((count, 1, 3), np.float32))

    ground, carton = box(500, [-1, -1, 0], [1, 1, 0]), box(500, [0.3, -0.2, 0], [0.32, 0.2, 0.6])
    state = State.of_initial(concatenate_splats([ground, carton]), np.zeros(1000, np.float32), ("a", "b"))
    support = Support(np.array([0.0, 0, 1]), 0.0, 0.002)
    assert not _stands(state, 1, box(200, [0.28, -0.1, 0.05], [0.3, 0.1, 0.2]), support)
    assert _stands(state, 1, box(200, [0.0, -0.1, 0], [0.2, 0.1, 0.2]), support)
    assert _stands(state, 1, box(200, [-0.5, -0.1, 0], [-0.2, 0.1, 0.03]), support)
    assert not _stands(state, 1, box(200, [-0.5, -0.1, 0.1], [-0.3, 0.1, 0.3]), support)
    # What stands so close that it touches is a thing all the same.
    assert _stands(state, 1, box(200, [0.1, -0.1, 0], [0.3, 0.1, 0.2]), support)
    # A sheet on the ground clings to nothing, however close what stands there is to the little of it that is higher.
    sheet = concatenate_splats(
        [box(190, [-0.3, -0.3, 0], [0.3, 0.3, 0.01]), box(10, [0.28, -0.1, 0.1], [0.3, 0.1, 0.1])]
    )
    assert _stands(state, 1, sheet, support)


def test_a_pose_of_now_that_a_visit_before_likes_as_well_was_the_pose_then():
    from ltgs_jax.pipeline.in_place import _stood_so
    from ltgs_jax.pipeline.looks import Eye, Observation
    from ltgs_jax.pipeline.state import State, add_template, came_to_place, scene_at, set_from

    rng = np.random.default_rng(3)

    def splats(count: int, half: list[float], middle: list[float], scale: float) -> Splats:
        colors = rng.uniform(-1.5, 1.5, (count, 1, 3)).astype(np.float32)
        means = (rng.uniform(-1, 1, (count, 3)) * half + middle).astype(np.float32)
        return Splats(
            means,
            np.tile(np.float32([1, 0, 0, 0]), (count, 1)),
            np.full((count, 3), np.log(scale), np.float32),
            np.full(count, 3, np.float32),
            colors,
        )

    def pose(x: float) -> SE3:
        return SE3(jnp.asarray([1.0, 0, 0, 0]), jnp.asarray([x, 0.0, 0]))

    state = State.of_initial(splats(300, [2, 2, 0.01], [0, 0, 5], 0.2), np.zeros(300, np.float32), ("a", "b", "c", "d"))
    state = add_template(state, Template(splats(60, [0.3, 0.3, 0.1], [0, 0, 4], 0.08), 1, 0), np.zeros(60), None, 0)
    moved = set_from(state, 2, 0, visible=True, pose=pose(0.5))
    assert [came_to_place(moved, t, 0) for t in range(4)] == [0, 0, 2, 2]
    away = set_from(moved, 3, 0, visible=False)
    assert came_to_place(set_from(away, 3, 0, visible=True), 3, 0) == 2

    eye, K = Eye(), jnp.asarray([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]])
    camera = Camera(SE3.identity(()), K, 64, 48)
    shown = eye.image(scene_at(moved, 2)[0], camera)
    seen = [Observation("c/0.png", camera, shown, np.ones((48, 64), bool))]
    config = pipeline.PRESETS["fast"]
    wrong = set_from(state, 2, 0, visible=True, pose=pose(0.35))
    assert _stood_so(wrong, 2, 0, pose(0.5), seen, eye=eye, config=config)
    assert not _stood_so(moved, 2, 0, pose(0.35), seen, eye=eye, config=config)
