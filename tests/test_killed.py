"""Stopped at any moment and started again, a run gives what an uninterrupted one gives; disk faults end cleanly."""

import errno
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import safetensors.numpy

from ltgs_jax import pipeline
from ltgs_jax.cli import main
from ltgs_jax.demo import make_capture
from ltgs_jax.io import files

TINY = pipeline.PRESETS["tiny"]


class _Quiet:
    def __init__(self):
        self.said = []

    def stage(self, name): ...

    def step(self, i, n, text=""): ...

    def note(self, text):
        self.said.append(text)

    def warn(self, text):
        self.said.append(text)


class _Stopped(BaseException):
    """As hard as an exception can be: no room catches it."""


def _results(out: Path) -> dict[str, bytes]:
    """What a run leaves that does not hold times or the machine."""
    skipped = {"stages.json", "env.json", "report.html"}
    return {
        str(path.relative_to(out)): path.read_bytes()
        for path in sorted(out.rglob("*"))
        if path.is_file() and path.name not in skipped and "stages" not in path.relative_to(out).parts
    }


def _update(capture: Path, out: Path) -> _Quiet:
    progress = _Quiet()
    pipeline.update(capture, out, config=TINY, progress=progress)
    return progress


def test_stopped_at_any_write_it_goes_on_to_the_same_result(tiny_run, tmp_path, monkeypatch):
    """Each time at a later write, before or after the file is renamed into place, then once to the end."""
    capture, whole = tiny_run
    out = tmp_path / "out"
    rng = random.Random(4)
    replace = os.replace
    for write in (2, 5, 7, 12, 18):
        left = [write]

        def stop(source, target, *, left=left):
            left[0] -= 1
            if left[0] == 0 and rng.random() < 0.5:
                raise _Stopped
            replace(source, target)
            if left[0] <= 0:
                raise _Stopped

        with monkeypatch.context() as patch:
            patch.setattr(files.Path, "replace", stop)
            with pytest.raises(_Stopped):
                _update(capture, out)
    _update(capture, out)
    assert _results(out) == _results(whole)


def test_a_full_disk_ends_in_one_line_and_costs_no_finished_stage(tiny_run, tmp_path, monkeypatch, capsys):
    capture, whole = tiny_run
    out = tmp_path / "out"
    sync, left = os.fsync, [6]

    def full(handle):
        left[0] -= 1
        if left[0] < 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        sync(handle)

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        assert main(["update", str(capture), "--out", str(out), "--preset", "tiny"]) in (1, 2)
    error = capsys.readouterr().err.splitlines()[-1]
    assert error.startswith("ltgs: ") and "No space left on device" in error
    assert not list(out.rglob(".*.json")), "a half-written file was left"
    whole_stages = [path.name for path in (out / "stages").iterdir()]
    assert whole_stages and all((whole / "stages" / name).is_file() for name in whole_stages)
    assert all(safetensors.numpy.load_file(out / "stages" / name) for name in whole_stages)


@pytest.mark.skipif(os.geteuid() == 0, reason="root writes to read-only folders")
def test_a_read_only_folder_is_named(tiny_run, tmp_path, capsys):
    (tmp_path / "locked").mkdir(mode=0o500)
    assert main(["update", str(tiny_run[0]), "--out", str(tmp_path / "locked" / "out"), "--preset", "tiny"]) == 2
    assert "locked" in capsys.readouterr().err


def test_a_file_where_the_folder_should_be_is_named(tiny_run, tmp_path, capsys):
    (tmp_path / "file").write_text("")
    for out in (tmp_path / "file", tmp_path / "file" / "out"):
        assert main(["update", str(tiny_run[0]), "--out", str(out), "--preset", "tiny"]) == 2
        error = capsys.readouterr().err.splitlines()[-1]
        assert str(out) in error and error.startswith("ltgs: ")


@pytest.mark.slow
def test_killed_twenty_times_it_goes_on_to_the_same_result(tmp_path):
    """SIGKILL at random moments of a run in a process of its own, on a built-in capture."""
    capture = make_capture(
        tmp_path / "capture", scene="move", seed=1, width=112, height=84, dense=14, update=3, test=1, points=1500
    )
    for visit in ("IMG_0002", "IMG_0003"):  # two visits tell what four would
        shutil.rmtree(capture / "images" / visit)
    _update(capture, tmp_path / "whole")
    out, rng, kills = tmp_path / "out", random.Random(0), 0
    program = "import sys; from ltgs_jax.cli import main; sys.exit(main(sys.argv[1:]))"
    words = [sys.executable, "-c", program, "update", str(capture), "--out", str(out), "--preset", "tiny"]
    while kills < 20:
        process = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        deadline = time.monotonic() + rng.uniform(2, 40)
        while time.monotonic() < deadline and process.poll() is None:
            time.sleep(0.05)
        if process.poll() is None:
            process.send_signal(signal.SIGKILL)
            process.wait()
        else:
            assert process.returncode == 0
            (out / "stages" / "fit.safetensors").unlink()  # it came through: there must be something left to kill
        kills += 1
    done = subprocess.run(words, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert _results(out) == _results(tmp_path / "whole")
