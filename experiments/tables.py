"""Every table and plot of docs/results.md, from nothing, with one command; interrupted, the same command goes on.

    python -m experiments.tables --preset fast [--out DIR] [--only comparison …] [--minutes 60] [--workers 2]
    python -m experiments.tables --preset fast --draw-only        draws again from DIR/table.csv

Presets: `tiny` is for trying things (minutes), `small` for a busy machine, `fast` for the page (meant for an hour on
two quiet cores), `paper` at the size of the paper's runs (a GPU). `--captures FOLDER …` adds folders of yours to the
comparison; `--cluster tcp://HOST:8786` runs on a Dask cluster. A sheet of `sheets()` is a name, its runs, and how its
rows are drawn from the table alone.
"""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import tyro

from experiments.baselines.method import MethodConfig
from experiments.baselines.system import RIGID, SystemConfig
from experiments.captures import CaptureConfig
from experiments.curves import chosen_points, curve_runs
from experiments.engine import Run, grid, read_table, rebuild_table, run_all, vary
from experiments.report import Sheet, write_results
from experiments.scenes import SceneConfig
from experiments.stability import stability_runs
from ltgs_jax.fit import InitialConfig
from ltgs_jax.pipeline import PRESETS as SYSTEM_PRESETS
from ltgs_jax.pipeline import for_small_photographs

_BASELINES = "experiments.baselines"
_SYSTEM = f"{_BASELINES}.system:run"
METHODS = {
    "untouched": f"{_BASELINES}.static:run_untouched",
    "3dgs-all": f"{_BASELINES}.static:run_all_photographs",
    "3dgs-refit": f"{_BASELINES}.static:run_refit",
    "few-shot": f"{_BASELINES}.few_shot:run",
    "deformation": f"{_BASELINES}.over_time:run_deformation",
    "steps": f"{_BASELINES}.over_time:run_steps",
    "local": f"{_BASELINES}.local:run",
    "expert": f"{_BASELINES}.expert:run",
    "3dgs-dense": f"{_BASELINES}.static:run_dense",
}
_STILL = ("nochange", "light")  # where nothing changes, the bound is the first visit's own fit
_LATER = ("3dgs-dense",)  # bounds, not rivals: they look at photographs that no other may


@dataclass(frozen=True)
class Preset:
    """How large everything is."""

    scene: SceneConfig
    steps: int
    """Of each fit of a baseline."""
    system: str
    """Preset of `ltgs update`."""
    scenes: tuple[str, ...] = ("move", "turnover", "clutter", "nochange", "light")
    seeds: tuple[int, ...] = (0,)
    effort: int = 1
    """Factor on the trials of the curves and of the stability page."""


PRESETS = {
    "tiny": Preset(
        SceneConfig(
            CaptureConfig(width=96, height=72, dense=8, update=2, test=1, points=800),
            96,
            InitialConfig(steps=60, max_splats=2000, sh_degree=0),
        ),
        steps=20,
        system="tiny",
        scenes=("move",),
    ),
    "small": Preset(SceneConfig(), steps=250, system="tiny"),
    "fast": Preset(
        SceneConfig(
            CaptureConfig(width=240, height=180, dense=30, points=4000),
            initial=InitialConfig(steps=500, max_splats=15_000, coarse_fraction=0.0),
        ),
        steps=200,
        system="fast",
    ),
    "paper": Preset(
        SceneConfig(
            CaptureConfig(width=640, height=480, dense=60, test=8, points=12000),
            640,
            InitialConfig(steps=7000, max_splats=200_000, sh_degree=3),
        ),
        steps=5000,
        system="paper",
        seeds=(0, 1, 2),
        effort=4,
    ),
}


@dataclass(frozen=True)
class Options:
    """What to run and where."""

    preset: str = "fast"
    """tiny, small, fast or paper."""
    out: Path = Path("out/experiments")
    """Folder of runs, captures, table.csv and the drawn page."""
    only: tuple[str, ...] = ()
    """Names of sheets; none means all."""
    captures: tuple[Path, ...] = ()
    """Folders to compare on besides the built-in captures."""
    max_side: int | None = None
    """Longest side at which photographs of such folders are worked on; None: the preset's."""
    minutes: float = 60.0
    """After so many minutes no further run is started; what is there is drawn."""
    workers: int = 2
    """Local processes, which share compiled programs on disk; 0: this one."""
    cluster: str | None = None
    """Address of a Dask scheduler."""
    retry: bool = False
    """Try failed runs again."""
    draw_only: bool = False
    """Draw from the table, run nothing."""
    page: Path | None = None
    """Markdown file whose generated part is written anew (docs/results.md); None: OUT/results.md alone."""
    images: Path | None = None
    """Folder of the plots; None: OUT/images."""


def _built_in(preset: Preset) -> list[SceneConfig]:
    """The captures of a preset."""
    return [
        vary(vary(preset.scene, "capture.scene", scene), "capture.seed", seed)
        for scene in preset.scenes
        for seed in preset.seeds
    ]


def _given(preset: Preset, options: Options) -> list[SceneConfig]:
    """Captures in folders."""
    side = options.max_side or preset.scene.max_side
    return [
        dataclasses.replace(preset.scene, capture=CaptureConfig(scene=str(folder)), max_side=side)
        for folder in options.captures
    ]


def comparison_runs(preset: Preset, given: list[SceneConfig]) -> dict[str, list[Run]]:
    """Every method on every capture."""
    built_in = _built_in(preset)
    scenes = built_in + given
    runs = {
        "ltgs": [Run(_SYSTEM, SystemConfig(scene, preset.system)) for scene in scenes],
        "rigid": [Run(_SYSTEM, SystemConfig(scene, preset.system, RIGID)) for scene in scenes],
    }
    for name, task in METHODS.items():
        chosen = [s for s in built_in if s.capture.scene not in _STILL] if name in _LATER else scenes
        runs[name] = [Run(task, MethodConfig(scene, preset.steps)) for scene in chosen]
    order = ("untouched", "ltgs", "rigid", *METHODS)
    return {name: runs[name] for name in dict.fromkeys(order)}


def _variants(
    preset: Preset, scenes: Sequence[SceneConfig], changes: dict[str, tuple[tuple[str, float | int | bool], ...]]
) -> dict[str, list[Run]]:
    """This system on some captures, with some of its options changed."""
    return {
        name: [Run(_SYSTEM, SystemConfig(scene, preset.system, overrides)) for scene in scenes]
        for name, overrides in changes.items()
    }


def _at_more_steps(preset: Preset, scene: SceneConfig) -> dict[str, list[Run]]:
    """This system beside a fit of every visit anew, with as many steps for each first scene, and four times those."""
    runs = {}
    for steps in (scene.initial.steps, 4 * scene.initial.steps):
        longer = vary(scene, "initial.steps", steps)
        runs[f"ltgs, {steps} steps"] = [Run(_SYSTEM, SystemConfig(longer, preset.system))]
        runs[f"3dgs-dense, {steps} steps"] = [Run(METHODS["3dgs-dense"], MethodConfig(longer, preset.steps))]
    return runs


def _with_photographs(scene: SceneConfig, count: int) -> SceneConfig:
    """A capture of which so many photographs of each later visit may be used, with one and the same held out."""
    return dataclasses.replace(scene, capture=dataclasses.replace(scene.capture, update=6, used=count))


def _whole(preset: Preset, scene: SceneConfig) -> dict[str, list[Run]]:
    """The whole system from the first visit on at each preset that is no dearer than this page's, the photographs at
    this page's size."""
    runs, names = {}, ["tiny", "fast", "paper"]
    for name in names[: names.index(preset.system) + 1]:
        base = scene
        if name != preset.system:
            base = dataclasses.replace(base, initial=for_small_photographs(SYSTEM_PRESETS[name]).fit.initial)
        runs[name] = [Run(_SYSTEM, SystemConfig(base, name))]
    return runs


ABLATION = {
    "full": (),
    "without known objects": (("template.tau_same", 2.0),),
    "without pose refinement": (("fit.long.fit_poses", False),),
    "without shades and shadows": (("fit.long.shade_rate", 0.0),),
    "without ground under what left": (("template.fill_splats", 0),),
    "without background refinement": (("fit.long.background_rate", 0.0),),
    "without photographs of the first visit": (("fit.long.replay", 0.0),),
    "without the long fit": (("fit.long.passes", 0),),
    "without mending": (("fit.mend.passes", 0),),
}
EVIDENCE = {
    "search alone": (("template.matches", False), ("fit.long.passes", 0)),
    "search and matches": (("fit.long.passes", 0),),
    "and registration": (("template.registration", True), ("fit.long.passes", 0)),
}
"""What proposes poses of known objects; as they are found, before the long fit."""
QUICK = (("fit.long.passes", 4),)
"""A quarter of the long fit, with which everything else is varied: it changes no event, and the hour is short."""
# Values beside those of the preset.
HYPERPARAMETERS = {"detect.sigmas": (3.0, 8.0), "match.min_new": (0.15, 0.6), "template.tau_same": (0.02, 0.08)}
PASSES = {"0 passes": (("fit.long.passes", 0),), "4 passes": QUICK, "as it is": ()}


def sheets(preset: Preset, options: Options) -> list[Sheet]:
    """All tables, in the order in which they are worked on."""
    scene = vary(preset.scene, "capture.scene", preset.scenes[min(1, len(preset.scenes) - 1)])
    base, given = SystemConfig(scene, preset.system, QUICK), _given(preset, options)
    changing = [s for s in _built_in(preset) if s.capture.scene not in _STILL] + given
    views: dict[str, list[Run]] = {}
    for count in (2, 3, 4, 6):
        scenes = [_with_photographs(s, count) for s in changing if s.capture.built_in]
        views |= _variants(preset, scenes, {f"{count} photographs a visit": QUICK})
    poses = grid(_SYSTEM, base, scene__capture__pose_noise=(0.0, 0.3, 1.0))
    features = grid(_SYSTEM, base, feature_noise=(0.0, 1.0))
    depths = grid(_SYSTEM, base, depth_noise=(0.0, 0.1))
    mistakes = {
        "as it is": base,
        "no mask in one photograph of each visit": dataclasses.replace(base, missing_masks=True),
        "one object not known again": dataclasses.replace(base, forgotten=True),
    }
    own = {"as it is": preset.system, "full": preset.system}
    hyper = {"as it is": QUICK} | {
        f"{name} {value}": (*QUICK, (name, value)) for name, values in HYPERPARAMETERS.items() for value in values
    }
    return [
        Sheet("comparison", "comparison", comparison_runs(preset, given)),
        Sheet("ablation", "variants", _variants(preset, changing, ABLATION), own),
        Sheet("evidence", "evidence", _variants(preset, changing, EVIDENCE)),
        Sheet("steps", "variants", _at_more_steps(preset, scene)),
        Sheet("curves", "curves", curve_runs(preset.effort), chosen_points()),
        Sheet("stability", "stability", stability_runs(preset.effort)),
        Sheet("views", "variants", views),
        Sheet("poses", "variants", {f"{r.options.scene.capture.pose_noise}° on given poses": [r] for r in poses}),
        Sheet("features", "variants", {f"{r.options.feature_noise} of a descriptor's norm": [r] for r in features}),
        Sheet("depths", "variants", {f"{r.options.depth_noise:.0%} of the depth": [r] for r in depths}),
        Sheet("mistakes", "variants", {name: [Run(_SYSTEM, config)] for name, config in mistakes.items()}, own),
        Sheet("hyperparameters", "variants", _variants(preset, [scene], hyper), own),
        Sheet("passes", "variants", _variants(preset, [scene], PASSES), own),
        Sheet("presets", "variants", _whole(preset, scene), {preset.system: "this page"}),
    ]


def main(options: Options) -> None:
    """Run what is missing, rebuild the table, draw."""
    if options.preset not in PRESETS:
        raise SystemExit(f"--preset: expected one of {', '.join(PRESETS)}, got {options.preset!r}")
    every = sheets(PRESETS[options.preset], options)
    names = [sheet.name for sheet in every]
    unknown = [name for name in options.only if name not in names]
    if unknown:
        raise SystemExit(f"--only: expected some of {', '.join(names)}, got {unknown[0]!r}")
    chosen = [sheet for sheet in every if not options.only or sheet.name in options.only]
    if options.draw_only:
        rebuild_table(options.out)
    else:
        runs = [run for sheet in chosen for group in sheet.runs.values() for run in group]
        run_all(
            runs,
            options.out,
            workers=options.workers,
            cluster=options.cluster,
            retry=options.retry,
            deadline=60 * options.minutes,
            say=lambda line: print(line, flush=True),
        )
    written = write_results(every, read_table(options.out), options.out, page=options.page, images=options.images)
    print(f"table: {options.out / 'table.csv'}; page: {written}")


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
