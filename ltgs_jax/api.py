"""Rank 6: what scripts need, by one import: `import ltgs_jax as ltgs`. Nothing happens here that a room does not do."""

import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from jaxtyping import Array, Float

from ltgs_jax import pipeline
from ltgs_jax.geometry import Camera as Camera
from ltgs_jax.io import Capture as Capture
from ltgs_jax.io import load_chronology
from ltgs_jax.io import read_capture as read_capture
from ltgs_jax.io import read_splats as read_splats
from ltgs_jax.io import read_tracks as read_tracks
from ltgs_jax.io import write_image as write_image
from ltgs_jax.io import write_splats as write_splats
from ltgs_jax.render import render as render_fully
from ltgs_jax.scene import Chronology as Chronology
from ltgs_jax.scene import Splats as Splats
from ltgs_jax.scene import compose as compose


@dataclass(frozen=True)
class _Lines:
    """A progress that says each stage, note and warning as a line."""

    say: Callable[[str], None]

    def stage(self, name: str) -> None:
        self.say(name)

    def step(self, i: int, n: int, text: str = "") -> None:
        del i, n, text  # too many for lines

    def note(self, text: str) -> None:
        self.say(f"  {text}")

    def warn(self, text: str) -> None:
        self.say(f"  warning: {text}")


def update(
    capture: str | Path,
    out: str | Path | None = None,
    *,
    preset: str = "fast",
    config: pipeline.Config | None = None,
    initial: str | Path | None = None,
    seed: int = 0,
    progress: Callable[[str], None] | None = None,
) -> Chronology:
    """Find what changed in a capture; `ltgs update` for scripts.

    `capture` is its folder (docs/formats.md); `out` the folder of the chronology, gone on with when it has stages of
    the same inputs (None: a temporary one, removed at the end); `preset` fast, paper or tiny, or `config` with every
    option; `initial` a trained splat scene of the first visit. `progress` is called with each line that a run says.
    Raises InputError (a ValueError), one line, for what is wrong with the capture; ValueError for an unknown preset.
    """
    if preset not in pipeline.PRESETS:
        raise ValueError(f"preset: expected one of {', '.join(pipeline.PRESETS)}, got {preset!r}")
    options = {"config": config or pipeline.PRESETS[preset], "initial": initial, "seed": seed}
    lines = _Lines(progress or (lambda line: None))
    if out is not None:
        return pipeline.update(capture, out, **options, progress=lines)
    with tempfile.TemporaryDirectory(prefix="ltgs-") as folder:
        return pipeline.update(capture, folder, **options, progress=lines)


def load(folder: str | Path) -> Chronology:
    """The chronology in a folder that `update` or `ltgs update` wrote. Raises InputError that names the file."""
    return load_chronology(folder)


def cameras(folder: str | Path) -> dict[str, Camera]:
    """The camera of each placed photograph by `<visit>/<name>`, at the photograph's full size, undistorted.

    `folder` is that of a chronology. Raises InputError that names the file.
    """
    _, found = pipeline.read_cameras(Path(folder))
    return {name: camera for name, (_, _, camera) in found.items()}


def render(splats: Splats, camera: Camera) -> Float[Array, "h w 3"]:
    """The image [h w 3] of splats, on black, in the splats' dtype.

    For alpha, depth, gradients and batches of cameras see `ltgs_jax.render.render`, of which this is the image alone.
    """
    return render_fully(splats, camera).image
