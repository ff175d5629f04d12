"""From a folder of photographs to a capture with the cameras of all visits."""

import zlib  # noqa: F401, I001  (before pycolmap, whose own zlib otherwise takes over the process and aborts it)
import shutil
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pycolmap
import pytest

from ltgs_jax.demo import make_capture as make_demo_capture
from ltgs_jax.io import InputError, Upright, read_capture, read_json, write_image, write_json
from ltgs_jax.localize import StructureConfig, choose_pairs
from ltgs_jax.localize.structure import _extract as extract_keypoints
from ltgs_jax.pipeline import IntakeConfig, make_capture
from ltgs_jax.pipeline.hold import only_run


class Silent:
    """A reporter that keeps warnings."""

    def __init__(self) -> None:
        self.warnings: list[str] = []

    def stage(self, name): ...

    def step(self, i, n, text=""): ...

    def note(self, text): ...

    def warn(self, text):
        self.warnings.append(text)


def _noise(path, seed):
    write_image(path, np.random.default_rng(seed).random((24, 40, 3)).astype(np.float32))


def test_pairs_reach_neighbours_and_look_alikes_only_once(tmp_path):
    photographs = [Upright(f"v/{i:02d}.png", 40, 24, None) for i in range(40)]
    for i, p in enumerate(photographs):
        _noise(tmp_path / p.name, i % 20)  # photograph i shows what photograph i + 20 shows
    few = choose_pairs(tmp_path, photographs[:5], StructureConfig())
    assert few == [[1, 2, 3, 4], [2, 3, 4], [3, 4], [4], []]
    config = StructureConfig(all_pairs=10, following=2, retrieved=1)
    pairs = choose_pairs(tmp_path, photographs, config)
    assert all(i + 20 in pairs[i] and i + 1 in pairs[i] for i in range(19))
    assert all(j > i for i, others in enumerate(pairs) for j in others)
    assert sum(map(len, pairs)) <= 40 * 3


def test_no_keypoint_is_taken_where_the_mask_is_zero(tmp_path):
    """What stands still in the picture while the camera moves would bend the whole structure."""
    photograph = Upright("v/a.png", 160, 120, None)
    noise = np.random.default_rng(0).random((30, 40, 3)).astype(np.float32)
    write_image(tmp_path / "images" / photograph.name, np.kron(noise, np.ones((4, 4, 1), np.float32)))
    mask = np.ones((120, 160, 3), np.float32)
    mask[60:] = 0
    write_image(tmp_path / "masks" / "v" / "a.png.png", mask)
    rows = {}
    for masks in (None, tmp_path / "masks"):
        database = tmp_path / f"{masks is None}.db"
        extract_keypoints(tmp_path / "images", [photograph], database, masks, StructureConfig(), False, lambda *_: None)
        with pycolmap.Database.open(database) as opened:
            rows[masks is None] = opened.read_keypoints(1)[:, 1]
    assert (rows[True] > 70).sum() > 20
    assert len(rows[False]) > 20 and rows[False].max() <= 60


def test_a_visit_that_cannot_be_a_first_one_is_refused(tmp_path):
    for i in range(2):
        _noise(tmp_path / "in" / "a" / f"{i}.png", i)
    for i in range(5):
        _noise(tmp_path / "in" / "b" / f"{i}.png", i)
    progress = Silent()
    with pytest.raises(InputError, match="3 are needed"):
        make_capture(tmp_path / "in", tmp_path / "out", progress=progress)
    assert any("--visits" in line for line in progress.warnings)
    assert not (tmp_path / "out").exists()


def test_a_folder_that_holds_something_is_left_alone(tmp_path):
    _noise(tmp_path / "in" / "a" / "0.png", 0)
    write_json(tmp_path / "out" / "mine.json", {})
    with pytest.raises(InputError, match="choose another --out"):
        make_capture(tmp_path / "in", tmp_path / "out", progress=Silent())
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["mine.json"]


def test_a_held_folder_is_refused_and_a_dead_run_s_is_not(tmp_path):
    program = (
        "import sys, pathlib, time; from ltgs_jax.pipeline.hold import only_run\n"
        "with only_run(pathlib.Path(sys.argv[1])): print('held', flush=True); time.sleep(600)"
    )
    holder = subprocess.Popen([sys.executable, "-c", program, str(tmp_path)], stdout=subprocess.PIPE, text=True)
    try:
        assert holder.stdout.readline() == "held\n"
        with pytest.raises(InputError, match=f"another run .process {holder.pid}."), only_run(tmp_path):
            pass
    finally:
        holder.kill()
        holder.wait()
        holder.stdout.close()
    with only_run(tmp_path):
        assert (tmp_path / ".running").exists()
    assert not (tmp_path / ".running").exists()


def test_an_interrupted_intake_goes_on_and_other_options_start_over(tmp_path, monkeypatch):
    """Structure from motion is stopped; what was brought in before stays, unless the options are others."""
    for i in range(3):
        _noise(tmp_path / "in" / "a" / f"{i}.png", i)

    def stop(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("ltgs_jax.pipeline.intake.reconstruct", stop)
    images = tmp_path / ".out.making" / "images" / "a"
    times = []
    for config in (IntakeConfig(), IntakeConfig(), IntakeConfig(max_side=20)):
        with pytest.raises(KeyboardInterrupt):
            make_capture(tmp_path / "in", tmp_path / "out", config=config, progress=Silent())
        assert not (tmp_path / "out").exists() and not (tmp_path / ".out.making" / ".running").exists()
        times.append({path.name: path.stat().st_mtime_ns for path in images.iterdir()})
    assert len(times[0]) == 3 and times[0] == times[1] and times[2] != times[1]


@pytest.mark.slow
def test_structure_of_known_cameras_is_found(tmp_path):
    """Photographs of a made-up room: after the best similarity, every camera is where it was."""
    truth = make_demo_capture(
        tmp_path / "truth", scene="move", seed=2, width=400, height=300, dense=20, update=3, test=0
    )
    shutil.copytree(truth / "images", tmp_path / "in")
    for listed in (tmp_path / "in").glob("*.txt"):
        listed.unlink()
    for visit in ("IMG_0002", "IMG_0003"):
        shutil.rmtree(tmp_path / "in" / visit)
    record = make_capture(tmp_path / "in", tmp_path / "out", progress=Silent())
    placed = {p["name"] for p in record["photographs"] if p["status"] in ("mapped", "localized")}
    assert len(placed) >= 22, record
    found = {p.name: p.camera for p in read_capture(tmp_path / "out").photographs if p.camera is not None}
    given = {p.name: p.camera for p in read_capture(truth).photographs}
    names = sorted(found)
    mine = np.stack([np.asarray(found[n].center(), float) for n in names])
    true = np.stack([np.asarray(given[n].center(), float) for n in names])
    a, b = mine - mine.mean(axis=0), true - true.mean(axis=0)
    u, s, vt = np.linalg.svd(b.T @ a)
    sign = np.diag([1, 1, np.sign(np.linalg.det(u @ vt))])
    aligned = a @ (u @ sign @ vt).T * (np.trace(np.diag(s) @ sign) / (a**2).sum())
    assert np.median(np.linalg.norm(aligned - b, axis=1)) < 0.01 * np.linalg.norm(np.ptp(true, axis=0))
    focal = record["lenses"][0]["params"][0]
    assert focal == pytest.approx(float(given[names[0]].K[0, 0]), rel=0.03)
    again = make_capture(tmp_path / "in", tmp_path / "out", progress=Silent())
    assert again == read_json(tmp_path / "out" / "capture.json")
    with pytest.raises(InputError, match="another capture"):
        make_capture(tmp_path / "in", tmp_path / "out", config=replace(IntakeConfig(), later=2), progress=Silent())
