"""Rank 3: cameras of new photographs against the initial model."""

from .place import localize as localize
from .types import Localization as Localization
from .types import LocalizeConfig as LocalizeConfig
from .types import PhotographStatus as PhotographStatus
