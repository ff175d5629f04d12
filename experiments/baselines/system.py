"""This system, with any option changed; and what is left of it that resembles 3DGS-CD.

ltgs: `ltgs_jax.pipeline.update` from the shared initial scene.

rigid, after 3DGS-CD (Lu et al. 2025). Kept: objects of the initial scene are segmented where photographs differ,
moved rigidly or removed, and nothing is optimised afterwards. Left out: EfficientSAM and LightGlue (the default
front end stands in), two visits only. It is this pipeline with no new objects (`template.tau_new` beyond 1) and no
long fit, so its change detection and its poses are as good as this system's: kinder to it than its own would be.

Stages that an ablation shares with the plain run are taken from it, so that one of the long fit costs the long fit
alone; the seconds in the row are those that the stages took when they ran.
"""

import dataclasses
import json
import shutil
from dataclasses import dataclass, field
from pathlib import Path

from experiments.engine import vary
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
    seed: int = 0

    @property
    def label(self) -> str:
        """For lines of progress."""
        return f"{self.scene.capture.label} {' '.join(f'{k}={v}' for k, v in self.overrides)}"


class _Silent:
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
    if kept.is_dir() and not out.exists() and config.feature_noise == 0:
        shutil.copytree(kept, out / "stages")
    noise = {"front_end": _noisy(config)} if config.feature_noise > 0 else {}
    chronology = update(
        problem.folder, out, config=options, initial=initial_path, seed=config.seed, progress=_Silent(), **noise
    )
    if not config.overrides and not kept.exists() and config.feature_noise == 0:
        shutil.copytree(out / "stages", kept)
    stages = {row["stage"]: row for row in json.loads((out / "stages.json").read_text())}
    counted = [row for name, row in stages.items() if name not in ("outputs", "evaluate")]
    said = {m["key"]: m["value"] for m in json.loads((out / "metrics.json").read_text()) if m["visit"] is None}
    scenes = [drop_hidden(compose(chronology, t)) for t in range(len(problem.visits))]
    loaded = load_chronology(out)
    said |= {"templates": len(chronology.templates), "splats": sum(t.splats.count for t in chronology.templates)}
    said["splats"] += chronology.background.count
    row = score(problem, per_visit_answer(scenes, bytes_of(loaded), said), folder)
    return {
        **row,
        "seconds": sum(stage["seconds"] for stage in counted),
        "seconds_cpu": sum(stage["cpu_seconds"] for stage in counted),
        "seconds_compile": sum(stage["compile_seconds"] for stage in counted),
        "seconds_initial": initial_seconds["seconds_cpu"],
        **{f"seconds_stage_{name}": stage["cpu_seconds"] for name, stage in stages.items()},
    }


def _noisy(config: SystemConfig):
    """The default front end with noise on its dense descriptors, the same for the same image."""
    import zlib

    import numpy as np

    from ltgs_jax.features import Classical

    class Noisy(Classical):
        def fingerprint(self) -> str:
            return f"{super().fingerprint()} noise {config.feature_noise}"

        def describe(self, image):
            dense = super().describe(image)
            rng = np.random.default_rng(zlib.crc32(np.ascontiguousarray(image).tobytes()))
            shape = dense.features.shape
            features = dense.features + config.feature_noise / np.sqrt(shape[-1]) * rng.standard_normal(shape)
            features = features / np.linalg.norm(features, axis=-1, keepdims=True)
            return dataclasses.replace(dense, features=features.astype(np.float32))

    return Noisy()
