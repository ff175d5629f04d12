"""Every option of a run, one frozen dataclass per room, and the presets."""

from dataclasses import dataclass, field, replace

from ltgs_jax.detect import DetectConfig
from ltgs_jax.fit import InitialConfig, LongConfig
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


@dataclass(frozen=True)
class FitConfig:
    """The two optimisations."""

    initial: InitialConfig = field(default_factory=InitialConfig)
    long: LongConfig = field(default_factory=LongConfig)


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
            long=LongConfig(steps=5000),
        ),
    ),
    "tiny": replace(
        _FAST,
        io=IoConfig(max_side=160),
        fit=FitConfig(initial=InitialConfig(steps=250, max_splats=6000, sh_degree=0), long=LongConfig(steps=80)),
    ),
}
