"""How long work shows where it is: a bar on a terminal, plain lines elsewhere."""

import sys
import time
from typing import Protocol, TextIO

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

_SECONDS_BETWEEN_LINES = 10.0


class Reporter(Protocol):
    """What a stage of the pipeline says while it works."""

    def stage(self, name: str) -> None:
        """A stage begins."""

    def step(self, i: int, n: int, text: str = "") -> None:
        """Step `i` of `n` of this stage is done."""

    def note(self, text: str) -> None:
        """Something worth knowing."""

    def warn(self, text: str) -> None:
        """Something is wrong with the input, and work goes on."""

    def close(self) -> None:
        """No more will come."""


class LineReporter:
    """Plain lines, one for each stage, note and warning, and for steps one every ten seconds."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self._started = time.monotonic()
        self._last = 0.0
        self._stage = ""

    def stage(self, name: str) -> None:
        self._stage, self._last = name, time.monotonic()
        self._line(name)

    def step(self, i: int, n: int, text: str = "") -> None:
        now = time.monotonic()
        if now - self._last >= _SECONDS_BETWEEN_LINES:
            self._last = now
            self._line(f"{self._stage} {i}/{n} {text}".rstrip())

    def note(self, text: str) -> None:
        self._line(f"  {text}")

    def warn(self, text: str) -> None:
        self._line(f"  warning: {text}")

    def close(self) -> None:
        self._stream.flush()

    def _line(self, text: str) -> None:
        print(f"[{time.monotonic() - self._started:6.1f} s] {text}", file=self._stream, flush=True)


class BarReporter:
    """One bar for each stage."""

    def __init__(self, console: Console) -> None:
        self._console = console
        columns = ("{task.description}", BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
        self._bars = Progress(*columns, TextColumn("{task.fields[text]}", markup=False), console=console)
        self._bars.start()
        self._task = None

    def stage(self, name: str) -> None:
        self._finish()
        self._task = self._bars.add_task(name, total=None, text="")

    def step(self, i: int, n: int, text: str = "") -> None:
        if self._task is not None:
            self._bars.update(self._task, completed=i, total=n, text=text)

    def note(self, text: str) -> None:
        self._console.print(f"  {text}", markup=False, highlight=False)

    def warn(self, text: str) -> None:
        self._console.print(f"  warning: {text}", style="yellow", markup=False, highlight=False)

    def close(self) -> None:
        self._finish()
        self._bars.stop()

    def _finish(self) -> None:
        """A stage without counted steps still ends as a full bar."""
        if self._task is not None:
            total = self._bars.tasks[self._task].total or 1
            self._bars.update(self._task, total=total, completed=total, text="")
            self._bars.stop_task(self._task)


def make_reporter(stream: TextIO | None = None) -> Reporter:
    """Bars when `stream` (stderr unless given) is a terminal, else plain lines."""
    stream = stream or sys.stderr
    console = Console(file=stream)
    return BarReporter(console) if console.is_terminal and not console.is_dumb_terminal else LineReporter(stream)
