"""The stages of `ltgs update`, in order; each leaves its result on disk and is taken up again from there."""

import dataclasses
import os
import platform
from collections.abc import Callable, Sequence
from functools import cache, partial
from importlib.metadata import version
from pathlib import Path
from typing import Protocol

import equinox as eqx
import jax
import numpy as np

from ltgs_jax.features import Classical, FrontEnd
from ltgs_jax.fit import (
    InitialConfig,
    VisitView,
    fit_chronology,
    fit_initial,
    mend_background,
    splats_from_points,
)
from ltgs_jax.io import (
    Capture,
    InputError,
    arrays_of,
    module_of,
    read_bytes,
    read_capture,
    read_ply,
    write_json,
)
from ltgs_jax.scene import Chronology, Splats, drop_hidden

from .cameras import Run, hold_against_renders, locate_photographs
from .carried import carry_on
from .config import Config, check_config
from .evaluate import evaluate
from .expected import expected_errors
from .hold import only_run
from .ledger import make_ledger
from .looks import Eye
from .outlook import look_ahead, say_outlook
from .outputs import never, write_outputs
from .programs import free_programs
from .prune import drop_idle, late_splats, merge_ground
from .state import Account, State, composed, pack_state, unpack_state
from .store import Store, digest
from .unknown import barely_shown, without_unexplained
from .views import first_views, later_views, load_views, observe
from .visit import explain_visit

_UNLIKE = "it differs from the scene all over: another place, another pose, or a room in which nothing stayed"


class Progress(Protocol):
    """Where a run says how far it is."""

    def stage(self, name: str) -> None: ...

    def step(self, i: int, n: int, text: str = "") -> None: ...

    def note(self, text: str) -> None: ...

    def warn(self, text: str) -> None: ...


def update(
    capture_dir: str | Path,
    out_dir: str | Path,
    *,
    config: Config,
    initial: str | Path | None = None,
    seed: int = 0,
    progress: Progress,
    front_end: FrontEnd | None = None,
    eye: Eye | None = None,
) -> Chronology:
    """Find what changed in a capture and write its chronology to `out_dir` (contract.md); run again, it resumes.

    `front_end` and `eye`, what describes photographs and what renders the scene, may be others than the defaults.
    Raises InputError, one line, for what is wrong with the capture or an option.
    """
    check_config(config, seed)
    out = Path(out_dir)
    capture = read_capture(capture_dir)
    given = Path(initial) if initial is not None else capture.initial_ply
    scene = read_ply(given) if given is not None else None
    front_end = front_end or Classical()
    with only_run(out):
        for name, reason in capture.problems:
            progress.warn(f"{name}: {reason}")
        write_json(
            out / "config.json", {**dataclasses.asdict(config), "seed": seed, "initial": str(given) if given else None}
        )
        write_json(out / "env.json", _environment())
        say_outlook(look_ahead(capture, config, None if scene is None else scene.count), progress)
        store = Store(out, progress)
        # The key of a stage holds what it reads and the key of the stage before: an option of a later stage leaves the
        # earlier ones as they are, and so does a visit that comes later.
        visits = range(len(capture.visits))
        files = [_files(capture, t) for t in visits]
        key = digest(config.io, config.localize, config.render, seed, files)
        run = locate_photographs(store, key, capture, config, seed, progress)
        brought = read_bytes(given) if given is not None else None
        poses, points = [run.poses(t) for t in visits], (capture.points, capture.point_colors)
        options = (config.io, config.render, config.fit.initial, config.detect.gamma)
        first = digest(*options, seed, files[0], *poses[0], *points, brought)
        eye = eye or Eye()
        means = _Means(store, front_end, eye, progress)
        splats, errors = _initial_scene(means, first, run, scene)
        key = digest(key, first, *(part for each in poses for part in each))
        run = hold_against_renders(store, digest(key, "align"), run, splats, eye, progress)
        photographs = cache(lambda: first_views(run, progress))  # decoded once for all stages
        key = digest(first, config.detect, config.match, config.template, config.register)
        told = _tell(means, key, run, files, splats, errors, photographs)
        if told.mended and config.fit.mend.again:
            key, again = digest(told.key, options), dataclasses.replace(means, store=store.again())
            mended, errors = _mended_scene(again, key, run, told.chronology, photographs)
            told = _tell(again, key, run, files, mended, errors, photographs)
        run, chronology, accounts = told.run, told.chronology, told.accounts
        _ledger(means, digest(told.key, "ledger"), chronology, accounts, told.later)
        write_outputs(out, run, chronology, splats, accounts, eye, store, progress)
        store.run("evaluate", never(), lambda: ({}, {"counts": {"rows": len(evaluate(out, capture_dir))}}))
    return chronology


@dataclasses.dataclass(frozen=True)
class _Means:
    """What a stage works with: where its result is kept, what describes photographs, what renders the scene, and where
    it says how far it is."""

    store: Store
    front_end: FrontEnd
    eye: Eye
    progress: Progress


@dataclasses.dataclass(frozen=True)
class _Told:
    """What the photographs of all visits tell: the run without those that tell nothing, the chronology, the accounts of
    each visit, the key of the last stage, the later photographs, and whether the background was mended."""

    run: Run
    chronology: Chronology
    accounts: list[list[Account]]
    key: str
    later: Callable[[], list[VisitView]]
    mended: bool


def _tell(means: _Means, key: str, run: Run, files: Sequence[list], splats: Splats, errors, first) -> _Told:
    """All visits explained in turn, against the splats of the first, then fitted together and mended."""
    config, states, accounts = run.config, [State.of_initial(splats, errors, run.capture.visits)], [[]]
    fits = [digest(key, "fit", config.fit.long)]
    for t in range(1, len(files)):
        key = digest(key, t, files[t], *run.poses(t))
        free_programs()
        state, told, run = _one_visit(means, key, run, states[-1], t)
        states.append(state)
        accounts.append(told)
        fits.append(digest(key, "fit", config.fit.long))
    later = cache(lambda: later_views(run, states[-1].chronology, means.eye, means.progress))
    fitted = _long_fit(means, fits, run, states, first, later)
    key = digest(fits[-1], "mend", config.fit.mend)
    chronology = _mend(means, key, run, fitted, first, later)
    return _Told(run, chronology, accounts, key, later, chronology is not fitted)


def _files(capture: Capture, visit: int) -> list[tuple]:
    """What tells the photographs of a visit, and their masks, from others."""

    def stamp(path: Path | None) -> tuple[int, int] | None:
        return None if path is None else (path.stat().st_size, path.stat().st_mtime_ns)

    return [(p.name, p.role, stamp(p.path), stamp(p.mask_path)) for p in capture.photographs if p.visit == visit]


def _initial_scene(means: _Means, key: str, run: Run, scene: Splats | None):
    """The first visit's splats, fitted or given, and the dissimilarity that each must be expected to leave."""

    def compute():
        views = [view for _, view in load_views(run, run.posed(0, "train"), means.progress)]
        if scene is None and not _startable(run):
            raise InputError(f"{run.capture.folder}: too few sparse points to start from; give --initial PLY")
        splats = _fit_first(run, views, run.config.fit.initial, means.progress) if scene is None else scene
        return _with_errors(means, run, splats, views)

    arrays, _ = means.store.run("initial", key, compute)
    return module_of(Splats, "splats", arrays), arrays["errors"]


def _mended_scene(means: _Means, key: str, run: Run, chronology: Chronology, first):
    """As `_initial_scene`, the mended scene of the first visit: what it shows better now tells changes better."""

    def compute():
        means.progress.note("the mended scene tells changes better: the visits are explained again")
        splats = drop_hidden(composed(chronology, 0))
        return _with_errors(means, run, splats, [v.view for v in first()])

    arrays, _ = means.store.run("initial", key, compute)
    return module_of(Splats, "splats", arrays), arrays["errors"]


def _with_errors(means: _Means, run: Run, splats: Splats, views) -> tuple[dict, dict]:
    """Splats and what difference is to be expected of each, as a stage leaves them."""
    options = run.config.fit.initial
    short = dataclasses.replace(options, steps=-(-options.steps // 4), grow_every=-(-options.grow_every // 4))
    means.progress.note("measuring what difference is to be expected")
    errors = expected_errors(
        means.eye,
        splats,
        views,
        means.front_end,
        gamma=run.config.detect.gamma,
        fit_to=partial(_fit_first, run, options=short, progress=means.progress) if _startable(run) else None,
        progress=means.progress,
    )
    return {**arrays_of("splats", splats), "errors": errors}, {"counts": {"splats": splats.count}}


def _startable(run: Run) -> bool:
    """Whether there are points enough to fit a scene from."""
    return len(run.capture.points) >= 4


def _fit_first(run: Run, views, options: InitialConfig, progress) -> Splats:
    """Splats fitted to photographs of the first visit, from its sparse points."""
    start = splats_from_points(
        run.capture.points,
        run.capture.point_colors,
        capacity=options.max_splats,
        sh_degree=options.sh_degree,
    )
    return fit_initial(start, views, key=jax.random.key(run.seed), config=options, progress=progress.step).splats


def _one_visit(means: _Means, key: str, run: Run, state: State, t: int):
    """Explain one visit; its state on disk. The run goes on without the photographs that differ all over."""
    config, eye, progress = run.config, means.eye, means.progress

    def compute():
        observations = observe(run, state, t, eye, progress)
        rng = np.random.default_rng([run.seed, t])
        explained = explain_visit(
            state,
            t,
            observations,
            means.front_end,
            earlier=cache(lambda visit: observe(run, state, visit, eye, progress)),  # decoded once for all objects
            eye=eye,
            config=config,
            rng=rng,
            progress=progress,
        )
        after, accounts, masks = explained.state, explained.accounts, explained.masks
        changed = float(np.mean([m.mean() for m in masks])) if masks else 0.0
        counts = {
            "photographs": len(masks),
            "changed_pixels": round(changed, 5),
            "objects": len(accounts),
            "templates_added": len(after.chronology.templates) - len(state.chronology.templates),
        }
        for account in accounts:
            identity = after.chronology.templates[account.template].identity
            progress.note(f"{run.capture.visits[t]}: object {identity} {account.kind}")
        arrays, notes = pack_state(after)
        told = [a.to_json() for a in accounts]
        return arrays, {**notes, "accounts": told, "unlike": explained.unlike, "counts": counts}

    arrays, notes = means.store.run(f"visit_{t:03d}", key, compute)
    for name in notes["unlike"]:
        progress.warn(f"{name}: left out, {_UNLIKE}")
    accounts = [Account.from_json(a) for a in notes["accounts"]]
    run = dataclasses.replace(run, found=run.found.without(dict.fromkeys(notes["unlike"], _UNLIKE)))
    if notes["unlike"] and not run.posed(t, "update"):
        progress.warn(f"{run.capture.visits[t]}: none of its photographs tells anything, the scene stays as it was")
    return unpack_state(arrays, notes, run.capture.visits), accounts, run


def _long_fit(means: _Means, keys: Sequence[str], run: Run, states: Sequence[State], first, later) -> Chronology:
    """The chronology with everything fitted together; skipped, and said so, when nothing changed. From what a fit left
    on disk of fewer visits (by the keys of each number of them) it goes on: the visits since then alone are new."""
    config, state, progress = run.config, states[-1], means.progress

    def compute():
        if not state.chronology.templates:
            progress.note("nothing changed: the chronology is the initial scene")
            arrays, notes = pack_state(state)
            return arrays, {**notes, "counts": {"steps": 0}}
        lean = merge_ground(state)
        merged = state.chronology.background.count - lean.chronology.background.count
        late = late_splats(lean, states[0].chronology.background)
        since, earlier = _earlier_fit(means.store, keys, run, states)
        gone = np.zeros(len(late), bool)
        if earlier is not None:
            lean, gone = carry_on(lean, *earlier)
            names = ", ".join(run.capture.visits[since:])
            progress.note(f"going on from the fit of the visits before {names}")
        fitted, losses, idle = lean, np.zeros(0), np.zeros((~gone).sum(), bool)
        if earlier is None or not eqx.tree_equal(states[since - 1], state):
            chronology, losses = fit_chronology(
                lean.chronology,
                first() + later(),
                key=jax.random.key(run.seed + since),
                since=since,
                config=config.fit.long,
                progress=progress.step,
            )
            fitted = eqx.tree_at(
                lambda s: s.chronology, lean, jax.tree.map(np.asarray, chronology), is_leaf=lambda x: x is None
            )
            fitted, idle = drop_idle(fitted, late[~gone], later(), means.eye)
        arrays, notes = pack_state(fitted)
        counts = {"steps": len(losses), "splats_merged": merged, "splats_dropped": int(idle.sum())}
        gone[np.flatnonzero(~gone)[idle]] = True
        return {**arrays, "gone": gone}, {**notes, "counts": counts}

    arrays, notes = means.store.run("fit", keys[-1], compute)
    return unpack_state(arrays, notes, run.capture.visits).chronology


def _mend(means: _Means, key: str, run: Run, chronology: Chronology, first, later) -> Chronology:
    """The chronology with its background fitted on, where photographs of later visits show much that those of the first
    hardly did; skipped, and said so, where they do not."""
    config, eye, progress = run.config.fit.mend, means.eye, means.progress

    def compute():
        if config.passes == 0 or not chronology.templates or not first() or not later():
            return {}, {"mended": False, "counts": {"steps": 0}}
        barely, share = barely_shown(chronology, first(), later(), eye)
        known = share < config.share
        progress.note(
            f"{100 * share:.0f} % of what later photographs show was hardly shown at the first visit: "
            + ("not mended" if known else "mending it")
        )
        if known:
            return {}, {"mended": False, "counts": {"unknown": round(share, 4), "steps": 0}}
        found = mend_background(
            chronology,
            first() + without_unexplained(chronology, barely, later(), eye, sigmas=run.config.detect.sigmas),
            key=jax.random.key(run.seed),
            config=config,
            progress=progress.step,
        )
        (was, now), (first_was, first_now) = found.unseen, found.first
        progress.note(
            f"held-out squares: mean error {was:.4f}, mended {now:.4f}; first visit {first_was:.4f}, {first_now:.4f}"
            + ("" if found.kept else ": not kept")
        )
        errors = {"held_out": found.unseen, "first_visit": found.first}
        counts = {"unknown": round(share, 4), "steps": len(found.losses), "kept": int(found.kept)}
        arrays = arrays_of("background", jax.tree.map(np.asarray, found.chronology.background)) if found.kept else {}
        return arrays, {"mended": found.kept, "errors": errors, "counts": counts}

    arrays, notes = means.store.run("mend", key, compute)
    if not notes["mended"]:
        return chronology
    return eqx.tree_at(lambda c: c.background, chronology, module_of(Splats, "background", arrays))


def _earlier_fit(store: Store, keys: Sequence[str], run: Run, states: Sequence[State]):
    """The first visit that the fit on disk has not seen, and the state before that fit, the one after it, and what it
    left out; 1 and None where there is no such fit of anything that changed."""
    for t in reversed(range(1, len(keys) - 1)):
        found = store.peek("fit", keys[t])
        if found is not None and states[t].chronology.templates:
            arrays, notes = found
            return t + 1, (merge_ground(states[t]), unpack_state(arrays, notes, run.capture.visits), arrays["gone"])
    return 1, None


def _ledger(means: _Means, key: str, chronology: Chronology, accounts, later) -> None:
    """What each visit added and what that bought, in stages.json."""

    def compute():
        views = later() if chronology.templates else []
        ledger = make_ledger(chronology, accounts, views, means.eye, progress=means.progress.step)
        return {}, {"counts": {"ledger": ledger}}

    means.store.run("ledger", key, compute)


def _environment() -> dict:
    """Versions and device."""
    packages = (
        "jax",
        "jaxlib",
        "equinox",
        "optimistix",
        "optax",
        "numpy",
        "opencv-contrib-python-headless",
        "pycolmap",
    )
    return {
        "python": platform.python_version(),
        "platform": platform.platform(),
        "packages": {name: version(name) for name in packages},
        "devices": [str(device) for device in jax.devices()],
        "cores": os.cpu_count(),
    }
