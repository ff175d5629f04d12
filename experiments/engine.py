"""The sweep engine: a run is a frozen config; its folder is named by the hash of that config; rows make one table.

    OUT/runs/<hash>/config.json env.json metrics.json renders/       one folder per run
    OUT/table.csv                                                    rebuilt from the folders, at any time

`Run(task, options)`: `task` is "module:function", called as `function(options, folder, cache) -> dict` of numbers
and words, `options` a frozen (nested) dataclass. A finished folder is not run again; a failure is a row too, with
its reason in one line, and is tried again only with `retry`. Keys that start with "seconds" or "fps" tell of the
machine, all others of the result: on one machine's CPU those are the same to the last digit when a folder is deleted
and run again.

Runs go one by one (`workers=0`), over local processes, or over a Dask cluster (`cluster="tcp://…"`, extra
`cluster`). Dask and not Ray: it is pure Python and BSD-licensed, installs in seconds, and a scheduler with workers
is two commands on any cluster. The folders must then lie on a disk that every worker sees.
"""

import csv
import dataclasses
import hashlib
import importlib
import json
import math
import os
import platform
import time
import traceback
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from importlib.metadata import version
from itertools import product
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from ltgs_jax.cli.main import compile_quickly
from ltgs_jax.pipeline.programs import free_programs

MACHINE = ("seconds", "fps")
"""Starts of the names of columns that tell of the machine and its load, not of the result."""


@dataclass(frozen=True)
class Run:
    """One run: what to call, and with which options."""

    task: str
    options: Any

    def config(self) -> dict:
        """As config.json holds it."""
        return {"task": self.task, "options": dataclasses.asdict(self.options)}

    @property
    def name(self) -> str:
        """Twelve hexadecimal digits that say everything that the run's result depends on."""
        return hashlib.sha256(json.dumps(self.config(), sort_keys=True, default=str).encode()).hexdigest()[:12]


def vary(options: Any, path: str, value: Any) -> Any:
    """`options` with the field at a dotted path replaced. Raises ValueError when there is none."""
    head, _, rest = path.partition(".")
    if head not in {field.name for field in dataclasses.fields(options)}:
        raise ValueError(f"{path}: {type(options).__name__} has no field {head}")
    if rest:
        value = vary(getattr(options, head), rest, value)
    return dataclasses.replace(options, **{head: value})


def grid(task: str, options: Any, **axes: Sequence[Any]) -> list[Run]:
    """Every combination of values; an axis is a dotted path with `__` for the dots."""
    runs = []
    for values in product(*axes.values()):
        varied = options
        for path, value in zip(axes, values, strict=True):
            varied = vary(varied, path.replace("__", "."), value)
        runs.append(Run(task, varied))
    return runs


class Clock:
    """Seconds of a stretch of work: on the wall, of all threads, and those of them that XLA spent compiling."""

    _compiled = 0.0
    _listening = False

    def __enter__(self) -> "Clock":
        if not Clock._listening:
            import jax

            jax.monitoring.register_event_duration_secs_listener(_note_compilation)
            Clock._listening = True
        self._start = time.perf_counter(), time.process_time(), Clock._compiled
        return self

    def __exit__(self, *_: object) -> None:
        self.wall, self.cpu, self.compile = (
            now - then
            for now, then in zip((time.perf_counter(), time.process_time(), Clock._compiled), self._start, strict=True)
        )

    def row(self) -> dict[str, float]:
        """The columns of a run."""
        return {"seconds": self.wall, "seconds_cpu": self.cpu, "seconds_compile": self.compile}


def _note_compilation(event: str, duration: float, **_: Any) -> None:
    if event.startswith("/jax/core/compile/"):
        Clock._compiled += duration


def write_json(path: Path, content: Any) -> None:
    """Whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f"{path.name}.{os.getpid()}.part")
    part.write_text(json.dumps(content, indent=1, default=str))
    part.replace(path)


def environment() -> dict:
    """Versions and machine, as env.json holds them."""
    packages = ("jax", "jaxlib", "equinox", "optimistix", "optax", "numpy")
    return {
        "python": platform.python_version(),
        "platform": platform.platform(),
        "cores": os.cpu_count(),
        "packages": {name: version(name) for name in packages},
    }


def execute(run: Run, out: Path, *, retry: bool = False) -> dict:
    """Do one run, unless its folder holds a result; return the row. Never raises for what the task raises."""
    folder = out / "runs" / run.name
    result = folder / "metrics.json"
    if result.is_file():
        row = json.loads(result.read_text())
        if row["status"] == "done" or not retry:
            return row
    write_json(folder / "config.json", run.config())
    write_json(folder / "env.json", environment())
    module, _, function = run.task.partition(":")
    try:
        row = {"status": "done", **getattr(importlib.import_module(module), function)(run.options, folder, out)}
    except Exception as error:
        (folder / "error.txt").write_text(traceback.format_exc())
        reason = (str(error) or type(error).__name__).splitlines()[0]
        row = {"status": "failed", "reason": f"{type(error).__name__}: {reason}"[:300]}
    write_json(result, row)
    free_programs()
    return row


def run_all(
    runs: Iterable[Run],
    out: Path,
    *,
    workers: int = 0,
    cluster: str | None = None,
    retry: bool = False,
    deadline: float | None = None,
    say: Callable[[str], None] = print,
) -> None:
    """Do all runs that have no result yet, then rebuild table.csv.

    `workers` local processes (0: in this one); `cluster` the address of a Dask scheduler instead. `deadline`: seconds
    of the wall clock after which no further run is started; the same command goes on later.
    """
    compile_quickly()  # for the workers too, which take over the environment
    waiting = list({run.name: run for run in runs}.values())
    waiting = [run for run in waiting if retry or not (out / "runs" / run.name / "metrics.json").is_file()]
    started = time.perf_counter()

    def late() -> bool:
        return deadline is not None and time.perf_counter() - started > deadline

    def tell(run: Run, row: dict) -> None:
        label = getattr(run.options, "label", "")
        end = "" if row["status"] == "done" else f" {row['reason']}"
        say(
            f"[{time.perf_counter() - started:7.1f} s] {run.name} {run.task.split(':')[0]} {label} {row['status']}{end}"
        )

    if cluster is not None:
        _on_cluster(waiting, out, cluster, retry, tell)
    elif workers == 0:
        for run in waiting:
            if not late():
                tell(run, execute(run, out, retry=retry))
    else:
        # Fresh interpreters: JAX's threads do not survive a fork.
        options = {"initializer": _share_programs, "initargs": (out.resolve() / "programs",)}
        with ProcessPoolExecutor(workers, mp_context=get_context("spawn"), **options) as pool:
            under_way: dict[Future, Run] = {}
            while waiting or under_way:
                while waiting and len(under_way) < workers and not late():
                    run = waiting.pop(0)
                    under_way[pool.submit(execute, run, out, retry=retry)] = run
                if not under_way:
                    break
                done = next(as_completed(under_way))
                tell(under_way.pop(done), done.result())
    rebuild_table(out)


def _share_programs(folder: Path) -> None:
    """What one worker compiled, the others take from disk."""
    import jax

    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)  # hundreds of small programs add up


def _on_cluster(runs: list[Run], out: Path, address: str, retry: bool, tell: Callable[[Run, dict], None]) -> None:
    import distributed

    with distributed.Client(address) as client:
        futures = {client.submit(execute, run, out, retry=retry, key=run.name, pure=False): run for run in runs}
        for future, row in distributed.as_completed(list(futures), with_results=True):
            tell(futures[future], row)


def rows_of(out: Path) -> list[dict]:
    """A row per finished or failed folder: its hash, its flattened config, its results; sorted by hash."""
    rows = []
    for result in sorted(out.glob("runs/*/metrics.json")):
        config = json.loads((result.parent / "config.json").read_text())
        flat = {"run": result.parent.name, "task": config["task"], **_flat(config["options"])}
        rows.append({**flat, **json.loads(result.read_text())})
    return rows


def _flat(options: Any, prefix: str = "") -> dict:
    """Nested options with dotted names."""
    if isinstance(options, dict):
        return {k: v for key, value in options.items() for k, v in _flat(value, f"{prefix}.{key}").items()}
    return {prefix.lstrip("."): json.dumps(options) if isinstance(options, list) else options}


def rebuild_table(out: Path) -> Path:
    """Write OUT/table.csv from the folders: config columns as they come, then results; floats to six digits."""
    rows = rows_of(out)
    columns = list(dict.fromkeys(key for row in rows for key in row))
    path = out / "table.csv"
    out.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="") as stream:
        writer = csv.DictWriter(stream, columns, restval="")
        writer.writeheader()
        writer.writerows([{key: _printed(value) for key, value in row.items()} for row in rows])
    return path


def _printed(value: Any) -> Any:
    return f"{value:.6g}" if isinstance(value, float) else value


def read_table(out: Path) -> dict[str, dict[str, Any]]:
    """The rows of table.csv by hash; numbers as floats, empty cells left out."""
    path = out / "table.csv"
    if not path.is_file():
        return {}
    with path.open(newline="") as stream:
        return {row["run"]: {k: _parsed(k, v) for k, v in row.items() if v != ""} for row in csv.DictReader(stream)}


def _parsed(key: str, text: str) -> Any:
    if key in ("run", "task", "status", "reason"):  # a hash of digits is no number
        return text
    try:
        return float(text)
    except ValueError:
        return text


def mean_of(rows: Iterable[dict], key: str) -> float:
    """Mean of a column over the rows that have it as a finite number; NaN when none has."""
    values = [row[key] for row in rows if isinstance(row.get(key), int | float) and math.isfinite(row[key])]
    return sum(values) / len(values) if values else math.nan
