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
from collections import Counter
from dataclasses import dataclass, field, replace
from pathlib import Path
from statistics import mean

from safetensors import safe_open
from safetensors.numpy import save_file

from experiments.engine import vary
from experiments.eyes import Blind, NoisyDepth
from experiments.front_ends import Noisy
from experiments.scenes import SceneConfig, initial_scene, load_problem, per_visit_answer, score
from ltgs_jax.io import read_tracks
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
    missing_masks: bool = False
    """Whether the first photograph of each later visit says nothing of change."""
    forgotten: bool = False
    """Whether the first object that a visit after the first change finds again is not known then: it gets a second
    identity."""
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
    undisturbed = config.feature_noise == config.depth_noise == 0 and not (config.missing_masks or config.forgotten)
    if config.forgotten and not kept.is_dir():
        run(replace(config, forgotten=False, overrides=()), folder / "plain", cache)
    if config.forgotten and not out.exists():
        shutil.copytree(kept, out / "stages")
        forget_one(out / "stages")
    if kept.is_dir() and not out.exists() and undisturbed:
        shutil.copytree(kept, out / "stages")
    noise = {"front_end": Noisy(sigma=config.feature_noise)} if config.feature_noise > 0 else {}
    noise |= {"eye": NoisyDepth(config.depth_noise)} if config.depth_noise > 0 else {}
    noise |= {"eye": Blind([problem.update[t][0].camera for t in problem.later])} if config.missing_masks else {}
    chronology = update(
        problem.folder, out, config=options, initial=initial_path, seed=config.seed, progress=Silent(), **noise
    )
    if not config.overrides and not kept.exists() and undisturbed:
        shutil.copytree(out / "stages", kept)
    said = {m["key"]: m["value"] for m in json.loads((out / "metrics.json").read_text()) if m["visit"] is None}
    scenes = [drop_hidden(compose(chronology, t)) for t in range(len(problem.visits))]
    said |= {"templates": len(chronology.templates), "splats": sum(t.splats.count for t in chronology.templates)}
    said["splats"] += chronology.background.count
    said |= confidence_of(read_tracks(out / "tracks.json"))
    won = winners(out)
    said |= {f"poses_by_{kind}": float(won[kind]) for kind in ("search", "matches", "registration")}
    row = score(problem, per_visit_answer(scenes, (out / "chronology.safetensors").stat().st_size, said), folder)
    return {
        **row,
        **stage_seconds(out),
        "seconds_initial": initial_seconds["seconds_cpu"],
    }


def confidence_of(tracks: dict) -> dict[str, float]:
    """The mean confidence of all that happened, as a column; none where nothing happened."""
    states = [state for each in tracks["objects"] for state in each["states"]]
    events = [state["confidence"] for state in states if state["event"] not in ("still", "unseen")]
    return {"confidence": mean(events)} if events else {}


def forget_one(stages: Path) -> None:
    """In the stages of a run, take from the template that a visit after the first change was first to find again what
    it stands on, without which it is not looked for, and all later stages away.

    Raises ValueError when no visit found any again.
    """
    visits = sorted(stages.glob("visit_*.safetensors"))
    known = len(_read_stage(visits[0])[1]["templates"])
    found = [a for path in visits[1:] for a in _read_stage(path)[1]["accounts"] if a["kind"] in ("moved", "added")]
    again = [a["template"] for a in found if a["template"] < known]
    if not again:
        raise ValueError(f"{stages}: no visit found an object of the first change again")
    content, _ = _read_stage(visits[0])
    arrays = {name: content.get_tensor(name) for name in content.keys()}  # noqa: SIM118 (no mapping)
    del arrays[f"template{again[0]}.support"]
    save_file(arrays, visits[0], content.metadata())
    kept = {"localize", "initial", "align", visits[0].stem}
    for path in stages.glob("*.safetensors"):
        if path.stem not in kept:
            path.unlink()


def _read_stage(path: Path):
    """A stage's file, open, and its notes."""
    content = safe_open(path, "numpy")
    return content, json.loads(content.metadata()["notes"])


def _stages(out: Path) -> dict[str, dict]:
    """What a chronology says of each of its stages."""
    return {row["stage"]: row for row in json.loads((out / "stages.json").read_text())}


def winners(out: Path) -> Counter[str]:
    """How many poses of known objects each kind of evidence proposed, by the ledger of a chronology."""
    stages = _stages(out)
    return Counter(row["evidence"] for row in stages["ledger"]["counts"]["ledger"] if row["evidence"])


def stage_seconds(out: Path) -> dict[str, float]:
    """The seconds that the stages of a chronology took when they ran: all but the outputs', and the CPU's of each."""
    stages = _stages(out)
    counted = [row for name, row in stages.items() if name not in ("outputs", "evaluate")]
    return {
        "seconds": sum(stage["seconds"] for stage in counted),
        "seconds_cpu": sum(stage["cpu_seconds"] for stage in counted),
        "seconds_compile": sum(stage["compile_seconds"] for stage in counted),
        **{f"seconds_stage_{name}": stage["cpu_seconds"] for name, stage in stages.items()},
    }
