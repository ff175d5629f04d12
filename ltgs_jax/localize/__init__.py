"""Rank 3: cameras of new photographs against the initial model."""

from .align import Alignment as Alignment
from .align import RenderView as RenderView
from .align import align_photograph as align_photograph
from .align import splat_view as splat_view
from .place import localize as localize
from .types import Localization as Localization
from .types import LocalizeConfig as LocalizeConfig
from .types import PhotographStatus as PhotographStatus
