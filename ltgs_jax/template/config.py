"""Options of the template stage."""

from dataclasses import dataclass


@dataclass(frozen=True)
class TemplateConfig:
    """How objects are cut out, built and found again."""

    min_pixels: float = 4e-4
    """Smallest evidence for an object, as a share of a photograph's pixels."""
    flat: float = 3.0
    """What rises above its support by less than this many times the support's noise is no object."""
    whole: float = 0.25
    """Share of the evidence on a thing that stands apart which must say that it left, for all of it to go."""
    cut_color: float = 0.5
    """Colour difference, in 0…1, at which two near splats are hardly taken to be of one object."""
    fill_splats: int = 2500
    """Most splats laid where an object's removal bares the surface below; 0: none are."""
    hull_resolution: int = 40
    """Voxels along the longest edge of a new object's visual hull."""
    new_splats: int = 2048
    """Most splats a new object starts with."""
    tau_new: float = 0.65
    """Share of the change that a new object must explain after its short fit."""
    new_steps: int = 80
    """Steps of the short fit of a new object, before its template is used."""
    new_opacity: float = 0.1
    """Opacity a new object's splats start with (the paper's)."""
    still_margin: float = 0.03
    """Relative unlikeness that an account must save before something that left is not taken to be still there."""
    yaw_steps: int = 16
    """Turns about the support's normal tried for a known template."""
    starts: int = 32
    """Poses, unlike each other, that are followed further, fewer from round to round."""
    matches: bool = True
    """Whether matches of a known template's renders with the photographs propose a pose, beside the search."""
    registration: bool = False
    """Whether registration of its surface with that of what came proposes one; to compile it takes most of a minute."""
    window: int = 56
    """Pixels along the edge of the windows in which poses are compared."""
    candidates: int = 2
    """Known templates, best by points, whose pose is refined for one arrival."""
    search_splats: int = 1024
    """Splats of a template while its pose is sought; half of them in small windows."""
    tau_search: float = 0.25
    """Share of the change that some known template, upright, must explain in the search; else all are laid on their
    other sides too."""
    tau_gain: float = -0.25
    """Share of the change that a known template must explain in the search, to be looked at closely; below 0 it looks
    worse than nothing, as at a wrong turn."""
    tau_remains: float = 0.35
    """Share of the change that may still be seen where a known template is put, for it to be what came."""
    tau_same: float = 0.04
    """Share of the change explained, times structural likeness, times recall (the share of what changed clearly that
    its outlines cover), from which on a known template is what came."""
    tau_sure: float = 0.2
    """The same product, from which on it need not be compared with a new object."""
    tau_shape: float = 0.5
    """Least overlap (IoU), over views, of a known template's outlines with those of the change as a new object."""
    tau_share: float = 0.2
    """Share of what a new object would explain that a known template, if it is not sure, must explain."""
    tau_outline: float = 0.75
    """Least share of a known template's outlines that nothing in the photographs speaks against."""
