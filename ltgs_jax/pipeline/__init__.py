"""Rank 5: the stages in order, what each leaves on disk, resume."""

from .config import PRESETS as PRESETS
from .config import Config as Config
from .config import for_small_photographs as for_small_photographs
from .evaluate import evaluate as evaluate
from .exports import FORMATS as FORMATS
from .exports import export as export
from .intake import IntakeConfig as IntakeConfig
from .intake import make_capture as make_capture
from .outputs import read_cameras as read_cameras
from .results import render_visit as render_visit
from .update import update as update
