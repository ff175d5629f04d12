"""Registration benchmark: success, error and time per cell, against baselines, as JSON and plots.

    python experiments/bench_register.py --problems FOLDER --out FOLDER [--parts cells bounds times batch inner plots]

FOLDER of problems holds a `problems.py` with CELLS, gen(suite, cell, trial) and errors(problem, R, t). Every finished
row is on disk: the same command again goes on where it stopped. `bunny.npy`-like data is the problems' own affair.
"""

import importlib.util
import itertools
import json
import resource
import time
from dataclasses import dataclass
from pathlib import Path

import bench_register_solvers as solvers
import jax
import jax.numpy as jnp
import numpy as np
import tyro

from ltgs_jax.register import register

NOISE_BOUND = 3.37
ANGLE, SHIFT = 5.0, 0.05


@dataclass(frozen=True)
class Options:
    """What to run."""

    problems: Path
    """Folder with problems.py."""
    out: Path
    """Folder of register.json and the plots."""
    parts: tuple[str, ...] = ("cells", "bounds", "times", "batch", "inner", "plots")
    trials: int = 40
    first: int = 0
    suites: tuple[str, ...] = ("P1", "P2", "P3", "P4", "P6")
    match: str = ""
    """Only the cells whose name contains this."""
    solvers: tuple[str, ...] = ("ltgs", "oracle", "pycolmap", "opencv", "icp")


class Table:
    """Rows on disk, keyed by what they measure."""

    def __init__(self, path: Path):
        self.path = path
        self.rows = json.loads(path.read_text()) if path.is_file() else []

    def has(self, **key) -> bool:
        return any(all(row.get(k) == v for k, v in key.items()) for row in self.rows)

    def add(self, row: dict) -> None:
        self.rows.append(row)
        self.path.write_text(json.dumps(self.rows, indent=1))
        print(json.dumps(row), flush=True)


def load_problems(folder: Path):
    """The module problems.py of a folder."""
    spec = importlib.util.spec_from_file_location("problems", folder / "problems.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def measure(problems, solve, suite: str, cell, trials: range, factor: float = 1.0) -> dict:
    """One row: a solver on the trials of a cell, with the noise bound off by `factor`."""
    angles, shifts, walls, cpus, verdicts = [], [], [], [], []
    for trial in trials:
        problem = problems.gen(suite, cell, trial)
        bound = NOISE_BOUND * problem["sigma"] * factor
        if trial == trials[0]:
            solve(problem, bound)  # compiles
        wall, cpu = time.perf_counter(), time.process_time()
        rotmat, xyz, verdict = solve(problem, bound)
        walls.append(time.perf_counter() - wall)
        cpus.append(time.process_time() - cpu)
        angle, shift = problems.errors(problem, rotmat, xyz)
        angles.append(angle)
        shifts.append(shift)
        verdicts.append(verdict)
    right = (np.array(angles) < ANGLE) & (np.array(shifts) < SHIFT)
    row = {
        "suite": suite,
        "cell": list(cell),
        "factor": factor,
        "trials": len(trials),
        "success": float(right.mean()),
        "rotation_deg": float(np.median(angles)),
        "translation_rel": float(np.median(shifts)),
        "wall_ms": 1e3 * float(np.median(walls)),
        "cpu_ms": 1e3 * float(np.median(cpus)),
    }
    if verdicts[0]:
        row |= {"right": right.tolist(), **{k: [v[k] for v in verdicts] for k in verdicts[0]}}
    return row


def run_cells(options: Options, problems, table: Table) -> None:
    """Every solver on every cell."""
    for suite in options.suites:
        for cell in problems.CELLS[suite]:
            for name in options.solvers:
                if options.match not in str(cell):
                    continue
                if name == "ltgs_covariances" and suite != "P2":
                    continue
                key = {"part": "cells", "solver": name, "suite": suite, "cell": list(cell), "first": options.first}
                if table.has(**key):
                    continue
                trials = range(options.first, options.first + options.trials)
                table.add(key | measure(problems, solvers.SOLVERS[name], suite, cell, trials))


BOUND_CELLS = (
    ("P1", (100, "onobj", 80)),
    ("P1", (100, "onobj", 90)),
    ("P1", (100, "sphere5", 90)),
    ("P3", ("mug", 200)),
    ("P3", ("box", 200)),
    ("P3", ("few10of200", 200)),
    ("P4", (200, 35, 30)),
    ("P6", (200, 10, 50)),
)


def run_bounds(options: Options, problems, table: Table) -> None:
    """The noise bound wrong by up to 4 either way."""
    for suite, cell in BOUND_CELLS:
        for factor in (0.25, 0.5, 1.0, 2.0, 4.0):
            key = {"part": "bounds", "solver": "ltgs", "suite": suite, "cell": list(cell), "factor": factor}
            key["first"] = options.first
            if options.match in str(cell) and not table.has(**key):
                trials = range(options.first, options.first + options.trials)
                row = measure(problems, solvers.SOLVERS["ltgs"], suite, cell, trials, factor)
                table.add(key | row)


def run_times(options: Options, problems, table: Table) -> None:
    """Time against the number of correspondences, 90 % outliers on a made-up object."""
    del problems
    for count in (50, 100, 200, 500, 1000, 2000, 5000):
        key = {"part": "times", "solver": "ltgs", "count": count}
        if table.has(**key):
            continue
        src, dst, rotmat = solvers.ellipsoid_problem(count, outliers=0.9, seed=count)
        start = time.perf_counter()
        register(src, dst, noise_bound=0.0337)
        first = time.perf_counter() - start
        walls, cpus = [], []
        for _ in range(5):
            wall, cpu = time.perf_counter(), time.process_time()
            answer = register(src, dst, noise_bound=0.0337)
            walls.append(time.perf_counter() - wall)
            cpus.append(time.process_time() - cpu)
        cosine = np.clip((np.trace(np.asarray(answer.dst_from_src.rotmat()).T @ rotmat) - 1) / 2, -1, 1)
        row = {"first_s": first, "wall_ms": 1e3 * min(walls), "cpu_ms": 1e3 * min(cpus)}
        row |= {"peak_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024}
        table.add(key | row | {"rotation_deg": float(np.degrees(np.arccos(cosine)))})


BATCH_CELLS = (("P4", (200, 25, 20)), ("P4", (200, 40, 30)), ("P3", ("mug", 200)), ("P6", (200, 20, 50)))


def run_batch(options: Options, problems, table: Table) -> None:
    """64 problems of N = 200 in one vmapped call, against as many single calls."""
    for suite, cell in BATCH_CELLS:
        key = {"part": "batch", "suite": suite, "cell": list(cell), "problems": 64}
        if options.match in str(cell) and not table.has(**key):
            table.add(key | measure_batch(problems, [problems.gen(suite, cell, trial) for trial in range(64)]))


@jax.jit
def _solve_batch(src, dst, bound):
    return jax.vmap(lambda a, b: register(a, b, noise_bound=bound))(src, dst)


def measure_batch(problems, cases: list[dict]) -> dict:
    """Success and time of one vmapped call, and of one call after the other by each solver."""
    bound = NOISE_BOUND * cases[0]["sigma"]
    src, dst = (jnp.asarray(np.stack([case[name] for case in cases]), jnp.float32) for name in ("src", "dst"))
    start = time.perf_counter()
    answer = jax.block_until_ready(_solve_batch(src, dst, bound))
    row = {"first_s": time.perf_counter() - start}
    walls, cpus = [], []
    for _ in range(5):
        wall, cpu = time.perf_counter(), time.process_time()
        answer = jax.block_until_ready(_solve_batch(src, dst, bound))
        walls.append(time.perf_counter() - wall)
        cpus.append(time.process_time() - cpu)
    row |= {"wall_ms": 1e3 * min(walls), "cpu_ms": 1e3 * min(cpus)}
    poses = np.asarray(answer.dst_from_src.as_matrix(), np.float64)
    row["success"] = share_right(problems, cases, [(pose[:3, :3], pose[:3, 3]) for pose in poses])
    for name in ("ltgs", "pycolmap"):
        solvers.SOLVERS[name](cases[0], bound)
        wall, cpu = time.perf_counter(), time.process_time()
        found = [solvers.SOLVERS[name](case, bound)[:2] for case in cases]
        row |= {
            f"{name}_wall_ms": 1e3 * (time.perf_counter() - wall),
            f"{name}_cpu_ms": 1e3 * (time.process_time() - cpu),
            f"{name}_success": share_right(problems, cases, found),
        }
    return row


def share_right(problems, cases: list[dict], found: list[tuple[np.ndarray, np.ndarray]]) -> float:
    """Share of answers within the limits."""
    errors = [problems.errors(case, *pose) for case, pose in zip(cases, found, strict=True)]
    return float(np.mean([angle < ANGLE and shift < SHIFT for angle, shift in errors]))


def run_inner(options: Options, problems, table: Table) -> None:
    """The final robust least squares by optimistix and by jaxopt, from the same starts."""
    for suite, cell in (("P1", (100, "onobj", 80)), ("P1", (1000, "onobj", 90)), ("P2", (300, 60, "iso"))):
        if table.has(part="inner", suite=suite, cell=list(cell)):
            continue
        cases = [problems.gen(suite, cell, trial) for trial in range(min(options.trials, 10))]
        for row in solvers.compare_inner(cases, problems.errors, NOISE_BOUND):
            table.add({"part": "inner", "suite": suite, "cell": list(cell)} | row)


def draw(options: Options, table: Table) -> None:
    """Error against outlier rate, time against N, time against error, confidence against truth."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(2, 2, figsize=(12, 9), layout="constrained")
    cells = [row for row in table.rows if row["part"] == "cells" and row["first"] == options.first]
    for name in dict.fromkeys(row["solver"] for row in cells):
        rows = [row for row in cells if row["solver"] == name and row["suite"] == "P1"]
        rows = sorted((row for row in rows if row["cell"][:2] == [1000, "onobj"]), key=lambda row: row["cell"][2])
        axes[0, 0].plot([r["cell"][2] for r in rows], [r["rotation_deg"] for r in rows], marker="o", label=name)
        every = [row for row in cells if row["solver"] == name]
        axes[1, 0].scatter([r["wall_ms"] for r in every], [r["rotation_deg"] for r in every], s=12, label=name)
    axes[0, 0].set(title="P1, N = 1000, on the object", xlabel="outliers, %", ylabel="median rotation error, deg")
    axes[1, 0].set(
        title="every cell", xlabel="time of one problem, ms", ylabel="median rotation error, deg", xscale="log"
    )
    for axis in (axes[0, 0], axes[1, 0]):
        axis.set_yscale("log")
        axis.legend()
    times = sorted((row for row in table.rows if row["part"] == "times"), key=lambda row: row["count"])
    axes[0, 1].loglog([r["count"] for r in times], [r["cpu_ms"] for r in times], marker="o")
    axes[0, 1].set(title="90 % outliers", xlabel="correspondences", ylabel="CPU time, ms")
    ours = [row for row in table.rows if row["part"] == "cells" and row["solver"] == "ltgs"]
    trust = np.concatenate([row["confidence"] for row in ours]) if ours else np.zeros(0)
    right = np.concatenate([row["right"] for row in ours]).astype(float) if ours else np.zeros(0)
    edges = np.array([0, 0.05, 0.2, 0.5, 0.8, 0.95, 1.0001])
    for low, high in itertools.pairwise(edges):
        inside = (trust >= low) & (trust < high)
        if inside.any():
            axes[1, 1].scatter(trust[inside].mean(), right[inside].mean(), s=10 * np.sqrt(inside.sum()), color="C0")
    axes[1, 1].plot([0, 1], [0, 1], color="gray", linewidth=0.5)
    axes[1, 1].set(title="confidence", xlabel="stated", ylabel="share right")
    figure.savefig(options.out / "register.png", dpi=100)


def main(options: Options) -> None:
    """Run the parts asked for."""
    options.out.mkdir(parents=True, exist_ok=True)
    problems = load_problems(options.problems)
    table = Table(options.out / "register.json")
    parts = {"cells": run_cells, "bounds": run_bounds, "times": run_times, "batch": run_batch, "inner": run_inner}
    for name in options.parts:
        if name in parts:
            parts[name](options, problems, table)
        elif name == "plots":
            draw(options, table)
        else:
            raise ValueError(f"parts: expected some of {[*parts, 'plots']}, got {name}")


if __name__ == "__main__":
    main(tyro.cli(Options))
