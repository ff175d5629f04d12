"""Shared fixtures. The persistent compilation cache keeps repeated runs short."""

import os
from pathlib import Path

os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(Path(__file__).parents[1] / ".jax_cache"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")

import pytest

from ltgs_jax.cli.main import compile_quickly

compile_quickly()


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of captures and benchmark problems beside the repository; tests that need it skip where it is not."""
    folder = Path(os.environ.get("LTGS_SHARED", Path(__file__).parents[2] / "shared"))
    if not folder.is_dir():
        pytest.skip(f"no folder of captures at {folder}")
    return folder
