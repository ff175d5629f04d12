"""Headless Chromium for tests of pages; a test that needs it is skipped, with the reason, where there is none."""

import re
import shutil
import subprocess
from pathlib import Path

import pytest

_NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
_FLAGS = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--hide-scrollbars",
    "--enable-logging=stderr",
)


def find_chromium() -> str:
    """The command, or the test is skipped."""
    found = next((path for path in map(shutil.which, _NAMES) if path), None)
    if found is None:
        pytest.skip("no Chromium on this machine: pages are not looked at in a browser")
    return found


def browse(url: str, profile: Path, *flags: str, timeout: float = 90) -> tuple[str, list[str]]:
    """Open a page with a fresh profile; what the browser prints, and the console's warnings and errors."""
    command = [find_chromium(), *_FLAGS, f"--user-data-dir={profile}", "--virtual-time-budget=5000", *flags, url]
    done = subprocess.run(command, capture_output=True, text=True, timeout=timeout, check=True)
    console = re.findall(r"(?:INFO|WARNING|ERROR):CONSOLE.*", done.stderr)
    return done.stdout, console
