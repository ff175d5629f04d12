"""Shared fixtures. The persistent compilation cache keeps repeated runs short."""

import fcntl
import os
import shutil
from pathlib import Path

os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(Path(__file__).parents[1] / ".jax_cache"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")

import pytest

import ltgs_jax as ltgs
from ltgs_jax.cli.main import compile_quickly

compile_quickly()


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of captures and benchmark problems beside the repository; tests that need it skip where it is not."""
    folder = Path(os.environ.get("LTGS_SHARED", Path(__file__).parents[2] / "shared"))
    if not folder.is_dir():
        pytest.skip(f"no folder of captures at {folder}")
    return folder


@pytest.fixture(scope="session")
def tiny_run(tmp_path_factory) -> tuple[Path, Path]:
    """A tiny capture and its uninterrupted run at preset tiny, one for all processes of the suite. Only to be read."""
    from tiny_capture import write_tiny_capture  # not above: `compile_quickly` comes before any use of jax

    base = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        base = base.parent
    made = base / "tiny"
    with (base / "tiny.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # another process waits for the first
        if not (made / "done").exists():
            shutil.rmtree(made, ignore_errors=True)
            write_tiny_capture(made / "capture")
            ltgs.update(made / "capture", made / "run", preset="tiny")
            (made / "done").touch()
    return made / "capture", made / "run"
