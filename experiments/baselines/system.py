"""This system, with any option changed; and what is left of it that resembles 3DGS-CD.

ltgs: `ltgs_jax.pipeline.update` from the shared initial scene.

rigid, after 3DGS-CD (Lu et al. 2025). Kept: objects of the initial scene are segmented where photographs differ,
moved rigidly or removed, and nothing is optimised afterwards. Left out: EfficientSAM and LightGlue (the default
front end stands in), two visits only. It is this pipeline with no new objects (`template.tau_new` beyond 1) and no
long fit, so its change detection and its poses are as good as this system's: kinder to it than its own would be.

Stages that an ablation shares with the plain run are taken from it, so that one of the long fit costs the long fit
alone; the seconds in the row are those that the stages took when they ran.
"""

import json
import shutil
from dataclasses import dataclass, field
from pathlib import Path

from experiments.engine import vary
from experiments.eyes import NoisyDepth
from experiments.front_ends import Noisy
from experiments.scenes import SceneConfig, bytes_of, initial_scene, load_problem, per_visit_answer, score
from ltgs_jax.io import load_chronology
from ltgs_jax.pipeline import PRESETS, update
from ltgs_jax.scene import compose, drop_hidden

RIGID = (("template.tau_new", 2.0), ("fit.long.passes", 0))
"""No new object ever explains twice the change; nothing is optimised."""


@dataclass(frozen=True)
class SystemConfig:
    """Options of this system's runs."""

    scene: SceneConfig = field(default_factory=SceneConfig)
    preset: str = "tiny"
    overrides: tuple[tuple[str, float | int | bool], ...] = ()
    """(dotted name, value) of options of `ltgs update` that differ from the preset."""
    feature_noise: float = 0.0
    """Standard deviation of noise on every dense descriptor, relative to its norm."""
    depth_noise: float = 0.0
    """Standard deviation of smooth noise on rendered depths, relative to them."""
    seed: int = 0

    @property
    def label(self) -> str:
        """For lines of progress."""
        return f"{self.scene.capture.label} {' '.join(f'{k}={v}' for k, v in self.overrides)}"


class Silent:
    """A progress that says nothing."""

    def stage(self, name: str) -> None: ...

    def step(self, i: int, n: int, text: str = "") -> None: ...

    def note(self, text: str) -> None: ...

    def warn(self, text: str) -> None: ...


def run(config: SystemConfig, folder: Path, cache: Path) -> dict:
    """The row of this system."""
    problem = load_problem(config.scene, cache)
    _, initial_path, initial_seconds = initial_scene(config.scene, problem, cache)
    options = vary(PRESETS[config.preset], "io.max_side", config.scene.max_side)
    for path, value in config.overrides:
        options = vary(options, path, value)
    out = folder / "chronology"
    kept = cache / "stages" / f"{problem.folder.name}_{config.preset}_{config.seed}_{initial_path.parent.name}"
    undisturbed = config.feature_noise == config.depth_noise == 0
    if kept.is_dir() and not out.exists() and undisturbed:
        shutil.copytree(kept, out / "stages")
    noise = {"front_end": Noisy(sigma=config.feature_noise)} if config.feature_noise > 0 else {}
    noise |= {"eye": NoisyDepth(config.depth_noise)} if config.depth_noise > 0 else {}
    chronology = update(
        problem.folder, out, config=options, initial=initial_path, seed=config.seed, progress=Silent(), **noise
    )
    if not config.overrides and not kept.exists() and undisturbed:
        shutil.copytree(out / "stages", kept)
    said = {m["key"]: m["value"] for m in json.loads((out / "metrics.json").read_text()) if m["visit"] is None}
    scenes = [drop_hidden(compose(chronology, t)) for t in range(len(problem.visits))]
    loaded = load_chronology(out)
    said |= {"templates": len(chronology.templates), "splats": sum(t.splats.count for t in chronology.templates)}
    said["splats"] += chronology.background.count
    row = score(problem, per_visit_answer(scenes, bytes_of(loaded), said), folder)
    return {
        **row,
        **stage_seconds(out),
        "seconds_initial": initial_seconds["seconds_cpu"],
    }


def stage_seconds(out: Path) -> dict[str, float]:
    """The seconds that the stages of a chronology took when they ran: all but the outputs', and the CPU's of each."""
    stages = {row["stage"]: row for row in json.loads((out / "stages.json").read_text())}
    counted = [row for name, row in stages.items() if name not in ("outputs", "evaluate")]
    return {
        "seconds": sum(stage["seconds"] for stage in counted),
        "seconds_cpu": sum(stage["cpu_seconds"] for stage in counted),
        "seconds_compile": sum(stage["compile_seconds"] for stage in counted),
        **{f"seconds_stage_{name}": stage["cpu_seconds"] for name, stage in stages.items()},
    }
