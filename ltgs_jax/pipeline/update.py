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

from ltgs_jax.detect import fit_tone
from ltgs_jax.features import Classical, FrontEnd
from ltgs_jax.fit import (
    Budget,
    InitialConfig,
    StreamedView,
    View,
    VisitView,
    fit_chronology,
    fit_initial,
    mend_background,
    splats_from_points,
)
from ltgs_jax.io import (
    Capture,
    InputError,
    Photograph,
    arrays_of,
    load_image,
    load_mask,
    module_of,
    read_bytes,
    read_capture,
    read_ply,
    write_json,
)
from ltgs_jax.scene import Chronology, Splats, drop_hidden

from .cameras import Run, hold_against_renders, locate_photographs, scaled_camera
from .carried import carry_on
from .config import Config, check_config
from .evaluate import evaluate
from .expected import expected_errors
from .hold import only_run
from .ledger import make_ledger
from .looks import Eye, Observation
from .outlook import look_ahead, say_outlook
from .outputs import never, write_outputs
from .programs import free_programs
from .prune import drop_idle, late_splats, merge_ground
from .state import Account, State, composed, pack_state, unpack_state
from .store import Store, digest
from .unknown import barely_shown, without_unexplained
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
        splats, errors = _initial_scene(store, first, run, scene, front_end, eye, progress)
        key = digest(key, first, *(part for each in poses for part in each))
        run = hold_against_renders(store, digest(key, "align"), run, splats, eye, progress)
        photographs = cache(lambda: _first_views(run, progress))  # decoded once for all stages
        key = digest(first, config.detect, config.match, config.template, config.register)
        told = _tell(store, key, run, files, splats, errors, photographs, front_end, eye, progress)
        if told.mended and config.fit.mend.again:
            key, again = digest(told.key, options), store.again()
            mended, errors = _mended_scene(again, key, run, told.chronology, photographs, front_end, eye, progress)
            told = _tell(again, key, run, files, mended, errors, photographs, front_end, eye, progress)
        run, chronology, accounts = told.run, told.chronology, told.accounts
        _ledger(store, digest(told.key, "ledger"), chronology, accounts, told.later, eye, progress)
        write_outputs(out, run, chronology, splats, accounts, eye, store, progress)
        store.run("evaluate", never(), lambda: ({}, {"counts": {"rows": len(evaluate(out, capture_dir))}}))
    return chronology


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


def _tell(
    store: Store, key: str, run: Run, files: Sequence[list], splats: Splats, errors, first, front_end, eye: Eye,
    progress,
) -> _Told:  # fmt: skip
    """All visits explained in turn, against the splats of the first, then fitted together and mended."""
    config, states, accounts = run.config, [State.of_initial(splats, errors, run.capture.visits)], [[]]
    fits = [digest(key, "fit", config.fit.long)]
    for t in range(1, len(files)):
        key = digest(key, t, files[t], *run.poses(t))
        free_programs()
        state, told, run = _one_visit(store, key, run, states[-1], t, front_end, eye, progress)
        states.append(state)
        accounts.append(told)
        fits.append(digest(key, "fit", config.fit.long))
    later = cache(lambda: _later_views(run, states[-1].chronology, eye, progress))
    fitted = _long_fit(store, fits, run, states, first, later, eye, progress)
    key = digest(fits[-1], "mend", config.fit.mend)
    chronology = _mend(store, key, run, fitted, first, later, eye, progress)
    return _Told(run, chronology, accounts, key, later, chronology is not fitted)


def _files(capture: Capture, visit: int) -> list[tuple]:
    """What tells the photographs of a visit, and their masks, from others."""

    def stamp(path: Path | None) -> tuple[int, int] | None:
        return None if path is None else (path.stat().st_size, path.stat().st_mtime_ns)

    return [(p.name, p.role, stamp(p.path), stamp(p.mask_path)) for p in capture.photographs if p.visit == visit]


def load_view(run: Run, photograph: Photograph) -> View:
    """A photograph as the fit sees it."""
    side = run.config.io.max_side
    image = load_image(photograph, max_side=side)
    return View(
        scaled_camera(run.cameras[photograph.name], side),
        np.rint(255 * image).astype(np.uint8),
        load_mask(photograph, max_side=side),
    )


def load_views(run: Run, photographs: Sequence[Photograph], progress) -> list[tuple[Photograph, StreamedView]]:
    """The photographs that can be decoded; one that cannot is named and left out, all of them are an error.

    Each is decoded once here; the pixels of as many as `io.photograph_bytes` holds stay in memory.
    """
    views, budget = [], Budget(run.config.io.photograph_bytes)
    for photograph in photographs:
        camera = scaled_camera(run.cameras[photograph.name], run.config.io.max_side)
        view = StreamedView(camera, partial(load_view, run, photograph), budget)
        try:
            view.check()
            views.append((photograph, view))
        except InputError as error:
            progress.warn(f"{photograph.name}: left out, {error}")
    if photographs and not views:
        raise InputError(
            f"{run.capture.folder}: none of the photographs of {photographs[0].name.split('/')[0]} is usable"
        )
    return views


def _initial_scene(store: Store, key: str, run: Run, scene, front_end, eye: Eye, progress):
    """The first visit's splats, fitted or given, and the dissimilarity that each must be expected to leave."""

    def compute():
        views = [view for _, view in load_views(run, run.posed(0, "train"), progress)]
        if scene is None and not _startable(run):
            raise InputError(f"{run.capture.folder}: too few sparse points to start from; give --initial PLY")
        splats = _fit_first(run, views, run.config.fit.initial, progress) if scene is None else scene
        return _with_errors(run, splats, views, front_end, eye, progress)

    arrays, _ = store.run("initial", key, compute)
    return module_of(Splats, "splats", arrays), arrays["errors"]


def _mended_scene(store: Store, key: str, run: Run, chronology: Chronology, first, front_end, eye: Eye, progress):
    """As `_initial_scene`, the mended scene of the first visit: what it shows better now tells changes better."""

    def compute():
        progress.note("the mended scene tells changes better: the visits are explained again")
        splats = drop_hidden(composed(chronology, 0))
        return _with_errors(run, splats, [v.view for v in first()], front_end, eye, progress)

    arrays, _ = store.run("initial", key, compute)
    return module_of(Splats, "splats", arrays), arrays["errors"]


def _with_errors(run: Run, splats: Splats, views, front_end, eye: Eye, progress) -> tuple[dict, dict]:
    """Splats and what difference is to be expected of each, as a stage leaves them."""
    options = run.config.fit.initial
    short = dataclasses.replace(options, steps=-(-options.steps // 4), grow_every=-(-options.grow_every // 4))
    progress.note("measuring what difference is to be expected")
    errors = expected_errors(
        eye,
        splats,
        views,
        front_end,
        gamma=run.config.detect.gamma,
        fit_to=partial(_fit_first, run, options=short, progress=progress) if _startable(run) else None,
        progress=progress,
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


def _observe(run: Run, state: State, t: int, eye: Eye, progress) -> list[Observation]:
    """The photographs of a visit in the light of the first."""
    observations = []
    for photograph, view in load_views(run, run.posed(t, "update"), progress):
        image = view.image.astype(np.float32) / 255
        tone = fit_tone(image, eye.image(state.chronology.background, view.camera), view.mask)
        if tone.changed:
            progress.note(f"{photograph.name}: other light, taken out")
        observations.append(Observation(photograph.name, view.camera, tone(image), view.mask))
    return observations


def _one_visit(store: Store, key: str, run: Run, state: State, t: int, front_end, eye: Eye, progress):
    """Explain one visit; its state on disk. The run goes on without the photographs that differ all over."""
    config = run.config

    def compute():
        observations = _observe(run, state, t, eye, progress)
        rng = np.random.default_rng([run.seed, t])
        explained = explain_visit(
            state,
            t,
            observations,
            front_end,
            earlier=cache(lambda visit: _observe(run, state, visit, eye, progress)),  # decoded once for all objects
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

    arrays, notes = store.run(f"visit_{t:03d}", key, compute)
    for name in notes["unlike"]:
        progress.warn(f"{name}: left out, {_UNLIKE}")
    accounts = [Account.from_json(a) for a in notes["accounts"]]
    run = dataclasses.replace(run, found=run.found.without(dict.fromkeys(notes["unlike"], _UNLIKE)))
    if notes["unlike"] and not run.posed(t, "update"):
        progress.warn(f"{run.capture.visits[t]}: none of its photographs tells anything, the scene stays as it was")
    return unpack_state(arrays, notes, run.capture.visits), accounts, run


def _long_fit(
    store: Store, keys: Sequence[str], run: Run, states: Sequence[State], first, later, eye: Eye, progress
) -> Chronology:
    """The chronology with everything fitted together; skipped, and said so, when nothing changed. From what a fit left
    on disk of fewer visits (by the keys of each number of them) it goes on: the visits since then alone are new."""
    config, state = run.config, states[-1]

    def compute():
        if not state.chronology.templates:
            progress.note("nothing changed: the chronology is the initial scene")
            arrays, notes = pack_state(state)
            return arrays, {**notes, "counts": {"steps": 0}}
        lean = merge_ground(state)
        merged = state.chronology.background.count - lean.chronology.background.count
        late = late_splats(lean, states[0].chronology.background)
        since, earlier = _earlier_fit(store, keys, run, states)
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
            fitted, idle = drop_idle(fitted, late[~gone], later(), eye)
        arrays, notes = pack_state(fitted)
        counts = {"steps": len(losses), "splats_merged": merged, "splats_dropped": int(idle.sum())}
        gone[np.flatnonzero(~gone)[idle]] = True
        return {**arrays, "gone": gone}, {**notes, "counts": counts}

    arrays, notes = store.run("fit", keys[-1], compute)
    return unpack_state(arrays, notes, run.capture.visits).chronology


def _mend(store: Store, key: str, run: Run, chronology: Chronology, first, later, eye: Eye, progress) -> Chronology:
    """The chronology with its background fitted on, where photographs of later visits show much that those of the first
    hardly did; skipped, and said so, where they do not."""
    config = run.config.fit.mend

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

    arrays, notes = store.run("mend", key, compute)
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


def _first_views(run: Run, progress) -> list[VisitView]:
    """The photographs of the first visit that it was fitted to."""
    return [VisitView(view, 0) for _, view in load_views(run, run.posed(0, "train"), progress)]


def _later_views(run: Run, chronology: Chronology, eye: Eye, progress) -> list[VisitView]:
    """The photographs of later visits that may be used, in the light of the first."""
    views = []
    for t in range(1, len(run.capture.visits)):
        loaded = load_views(run, run.posed(t, "update"), progress)
        scene = drop_hidden(composed(chronology, t)) if loaded else None
        for _, view in loaded:
            image = view.image.astype(np.float32) / 255
            tone = fit_tone(image, eye.image(scene, view.camera), view.mask)
            views.append(VisitView(View(view.camera, np.rint(255 * tone(image)).astype(np.uint8), view.mask), t))
    return views


def _ledger(store: Store, key: str, chronology: Chronology, accounts, later, eye: Eye, progress) -> None:
    """What each visit added and what that bought, in stages.json."""

    def compute():
        views = later() if chronology.templates else []
        return {}, {"counts": {"ledger": make_ledger(chronology, accounts, views, eye, progress=progress.step)}}

    store.run("ledger", key, compute)


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
