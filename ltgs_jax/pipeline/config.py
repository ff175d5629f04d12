"""Every option of a run, one frozen dataclass per room, and the presets."""

import math
from dataclasses import dataclass, field, fields, is_dataclass, replace
from typing import Any

from ltgs_jax.detect import DetectConfig
from ltgs_jax.fit import InitialConfig, LongConfig, MendConfig
from ltgs_jax.io import InputError
from ltgs_jax.localize import LocalizeConfig
from ltgs_jax.match import MatchConfig
from ltgs_jax.register import RegisterConfig
from ltgs_jax.render import RenderConfig
from ltgs_jax.template import TemplateConfig


@dataclass(frozen=True)
class IoConfig:
    """How photographs are read."""

    max_side: int = 640
    """Longest side in pixels at which photographs are fitted and compared; larger ones are scaled down."""
    photograph_bytes: int = 1 << 30
    """Bytes of decoded photographs that are kept; beyond, one is decoded again whenever it is needed."""


@dataclass(frozen=True)
class FitConfig:
    """The optimisations."""

    initial: InitialConfig = field(default_factory=InitialConfig)
    long: LongConfig = field(default_factory=LongConfig)
    mend: MendConfig = field(default_factory=MendConfig)


@dataclass(frozen=True)
class Config:
    """Options of `ltgs update`, by room."""

    io: IoConfig = field(default_factory=IoConfig)
    localize: LocalizeConfig = field(default_factory=LocalizeConfig)
    detect: DetectConfig = field(default_factory=DetectConfig)
    match: MatchConfig = field(default_factory=MatchConfig)
    template: TemplateConfig = field(default_factory=TemplateConfig)
    register: RegisterConfig = field(default_factory=RegisterConfig)
    fit: FitConfig = field(default_factory=FitConfig)
    render: RenderConfig = field(default_factory=RenderConfig)


_FAST = Config()
PRESETS: dict[str, Config] = {
    "fast": _FAST,
    "paper": replace(
        _FAST,
        io=IoConfig(max_side=1600),
        fit=FitConfig(
            initial=InitialConfig(steps=7000, max_splats=200_000, sh_degree=3),
            long=LongConfig(passes=60),
        ),
    ),
    "tiny": replace(
        _FAST,
        io=IoConfig(max_side=160),
        fit=FitConfig(initial=InitialConfig(steps=250, max_splats=6000, sh_degree=0), long=LongConfig(passes=8)),
    ),
}


def for_small_photographs(config: Config) -> Config:
    """Fewer steps and splats: the built-in captures are 240 × 180 pixels, the presets are made for 640.

    All steps at full size: a coarse start costs more to compile here than it saves.
    """
    initial = config.fit.initial
    steps, splats = min(initial.steps, 500), min(initial.max_splats, 15_000)
    initial = replace(initial, steps=steps, max_splats=splats, coarse_fraction=0.0)
    return replace(config, fit=replace(config.fit, initial=initial))


_LEAST = {
    "template.tau_gain": -math.inf,
    "io.max_side": 16,
    "fit.initial.max_splats": 4,
    "fit.initial.steps": 1,
    "fit.initial.batch": 1,
    "fit.initial.grow_every": 1,
    "fit.long.batch": 1,
}
_MOST = {"fit.initial.sh_degree": 3}


def check_config(config: Config, seed: int = 0) -> None:
    """Raises InputError that names the option, as the command line calls it, when no run could go with it."""
    _check("seed", seed)
    _check("", config)


def _check(name: str, value: Any) -> None:
    """Numbers are finite and not negative, and within what the code can do."""
    if is_dataclass(value):
        for item in fields(value):
            _check(f"{name}.{item.name}".lstrip("."), getattr(value, item.name))
    elif isinstance(value, tuple):
        for item in value:
            _check(name, item)
    elif isinstance(value, int | float) and not isinstance(value, bool):
        least, most = _LEAST.get(name, 0), _MOST.get(name, math.inf)
        if not (math.isfinite(value) and least <= value <= most):
            bound = f"at least {least}" if most == math.inf else f"{least} to {most}"
            raise InputError(f"--{name.replace('_', '-')} {value}: expected {bound}")
