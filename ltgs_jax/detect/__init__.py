"""Rank 3: rendered against captured, as masks."""

from .changes import ChangeMap as ChangeMap
from .changes import DetectConfig as DetectConfig
from .changes import change_map as change_map
from .changes import clean as clean
from .changes import colour_difference as colour_difference
from .changes import dilate as dilate
from .exposure import Tone as Tone
from .exposure import fit_tone as fit_tone
from .similarity import similarity as similarity
