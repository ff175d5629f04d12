"""Photographs as the stages take them: from disk, and those of later visits in the light of the first."""

from collections.abc import Sequence
from functools import partial

import numpy as np
from jaxtyping import Float

from ltgs_jax.detect import fit_tone
from ltgs_jax.fit import Budget, StreamedView, View, VisitView
from ltgs_jax.io import InputError, Photograph, load_image, load_mask
from ltgs_jax.scene import Chronology, Splats, drop_hidden

from .cameras import Run, scaled_camera
from .looks import Eye, Observation
from .state import State, composed


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


def first_views(run: Run, progress) -> list[VisitView]:
    """The photographs of the first visit that it was fitted to."""
    return [VisitView(view, 0) for _, view in load_views(run, run.posed(0, "train"), progress)]


def later_views(run: Run, chronology: Chronology, eye: Eye, progress) -> list[VisitView]:
    """The photographs of later visits that may be used, in the light of the first."""
    views = []
    for t in range(1, len(run.capture.visits)):
        loaded = load_views(run, run.posed(t, "update"), progress)
        scene = drop_hidden(composed(chronology, t)) if loaded else None
        for _, view in loaded:
            image, _ = _in_first_light(view, scene, eye)
            views.append(VisitView(View(view.camera, np.rint(255 * image).astype(np.uint8), view.mask), t))
    return views


def observe(run: Run, state: State, t: int, eye: Eye, progress) -> list[Observation]:
    """The photographs of a visit in the light of the first."""
    observations = []
    for photograph, view in load_views(run, run.posed(t, "update"), progress):
        image, changed = _in_first_light(view, state.chronology.background, eye)
        if changed:
            progress.note(f"{photograph.name}: other light, taken out")
        observations.append(Observation(photograph.name, view.camera, image, view.mask))
    return observations


def _in_first_light(view: StreamedView, scene: Splats, eye: Eye) -> tuple[Float[np.ndarray, "h w 3"], bool]:
    """A photograph in the light of a scene of the first visit's, in 0…1, and whether its own was another."""
    image = view.image.astype(np.float32) / 255
    tone = fit_tone(image, eye.image(scene, view.camera), view.mask)
    return tone(image), tone.changed
