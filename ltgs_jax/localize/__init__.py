"""Rank 3: cameras of new photographs against the initial model."""

from .align import Alignment as Alignment
from .align import RenderView as RenderView
from .align import align_photograph as align_photograph
from .align import correct_pose as correct_pose
from .object_pose import object_pose as object_pose
from .place import localize as localize
from .renders import align_later as align_later
from .structure import Structure as Structure
from .structure import StructureConfig as StructureConfig
from .structure import choose_pairs as choose_pairs
from .structure import reconstruct as reconstruct
from .types import Localization as Localization
from .types import LocalizeConfig as LocalizeConfig
from .types import PhotographStatus as PhotographStatus
