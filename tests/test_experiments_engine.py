"""The sweep engine: names, folders, resuming, failures, the table, processes, a cluster."""

import json
import shutil
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from experiments.engine import Run, execute, grid, mean_of, read_table, run_all, vary

ROOT = Path(__file__).parents[1]


@dataclass(frozen=True)
class _Inner:
    size: int = 2


@dataclass(frozen=True)
class _Options:
    inner: _Inner = field(default_factory=_Inner)
    label: str = "x"
    power: float = 2.0


def work(options: _Options, folder: Path, cache: Path) -> dict:
    """A task: counts its calls in the cache, fails for size 0."""
    calls = cache / "calls.txt"
    with calls.open("a") as stream:
        stream.write(f"{options.inner.size}\n")
    if options.inner.size == 0:
        raise ValueError("size: expected at least 1\nand a second line")
    return {"value": options.inner.size**options.power / 3, "seconds": float(len(calls.read_text()))}


_TASK = f"{__name__}:work"


def _calls(out: Path) -> list[str]:
    return (out / "calls.txt").read_text().split()


def test_a_name_depends_on_every_option_and_on_nothing_else():
    run = Run(_TASK, _Options())
    assert run.name == Run(_TASK, _Options()).name
    others = [
        Run("a:b", _Options()),
        *grid(_TASK, _Options(), inner__size=(3, 4)),
        *grid(_TASK, _Options(), power=(1.5,)),
    ]
    assert len({run.name, *(other.name for other in others)}) == 1 + len(others)
    with pytest.raises(ValueError, match="no field wrong"):
        vary(_Options(), "inner.wrong", 1)


def test_finished_runs_are_not_repeated_and_failures_are_rows(tmp_path):
    runs = grid(_TASK, _Options(), inner__size=(0, 1, 2))
    run_all(runs, tmp_path, say=lambda line: None)
    run_all(runs, tmp_path, say=lambda line: None)
    assert _calls(tmp_path) == ["0", "1", "2"]
    rows = read_table(tmp_path)
    assert rows[runs[0].name]["status"] == "failed"
    assert rows[runs[0].name]["reason"] == "ValueError: size: expected at least 1"
    assert rows[runs[2].name]["value"] == pytest.approx(4 / 3, rel=1e-5)
    assert rows[runs[2].name]["inner.size"] == 2
    assert mean_of(rows.values(), "value") == pytest.approx(5 / 6, rel=1e-5)
    run_all(runs, tmp_path, retry=True, say=lambda line: None)
    assert _calls(tmp_path) == ["0", "1", "2", "0"]


def test_no_run_is_started_after_the_deadline(tmp_path):
    run_all(grid(_TASK, _Options(), inner__size=(1, 2)), tmp_path, deadline=-1.0, say=lambda line: None)
    assert read_table(tmp_path) == {}


def test_the_table_is_rebuilt_from_the_folders_alone(tmp_path):
    runs = grid(_TASK, _Options(), inner__size=(1, 2))
    run_all(runs, tmp_path, say=lambda line: None)
    before = (tmp_path / "table.csv").read_bytes()
    (tmp_path / "table.csv").unlink()
    run_all(runs, tmp_path, say=lambda line: None)
    assert (tmp_path / "table.csv").read_bytes() == before
    shutil.rmtree(tmp_path / "runs" / runs[0].name)
    run_all([], tmp_path, say=lambda line: None)
    assert list(read_table(tmp_path)) == [runs[1].name]
    assert json.loads((tmp_path / "runs" / runs[1].name / "config.json").read_text())["options"]["inner"] == {"size": 2}


_SWEEP = """
from experiments.engine import run_all, grid
from tests.test_experiments_engine import _Options
from pathlib import Path
import sys
if __name__ == "__main__":
    runs = grid("tests.test_experiments_engine:work", _Options(), inner__size=(0, 1, 2, 3))
    run_all(runs, Path(sys.argv[1]), workers=2)
"""


def test_two_processes_give_the_same_table_as_one(tmp_path):
    runs = grid("tests.test_experiments_engine:work", _Options(), inner__size=(0, 1, 2, 3))
    alone, apart = tmp_path / "alone", tmp_path / "apart"
    for folder in (alone, apart):
        folder.mkdir()
    run_all(runs, alone, say=lambda line: None)
    script = tmp_path / "sweep.py"
    script.write_text(_SWEEP)
    environment = {"PYTHONPATH": str(ROOT), "PATH": "/usr/bin:/bin", "JAX_PLATFORMS": "cpu"}
    subprocess.run([sys.executable, str(script), str(apart)], check=True, cwd=ROOT, env=environment)
    assert _without_seconds(apart) == _without_seconds(alone)


def _without_seconds(out: Path) -> dict:
    return {name: {k: v for k, v in row.items() if k != "seconds"} for name, row in read_table(out).items()}


def test_a_cluster_of_two_workers_gives_the_same_table(tmp_path):
    distributed = pytest.importorskip("distributed", reason="the extra `cluster` is not installed")
    runs = grid("tests.test_experiments_engine:work", _Options(), inner__size=(0, 1, 2, 3))
    alone, apart = tmp_path / "alone", tmp_path / "apart"
    for folder in (alone, apart):
        folder.mkdir()
    run_all(runs, alone, say=lambda line: None)
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None) as cluster:
        run_all(runs, apart, cluster=cluster.scheduler_address, say=lambda line: None)
    assert _without_seconds(apart) == _without_seconds(alone)


def test_a_task_that_does_not_exist_is_a_row_too(tmp_path):
    row = execute(Run("experiments.nothing:run", _Options()), tmp_path)
    assert row["status"] == "failed"
    assert "ModuleNotFoundError" in row["reason"]
