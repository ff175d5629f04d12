"""Rank 5: the stages in order, what each leaves on disk, resume."""

from .config import PRESETS as PRESETS
from .config import Config as Config
from .evaluate import evaluate as evaluate
from .intake import IntakeConfig as IntakeConfig
from .intake import make_capture as make_capture
from .results import export_visit as export_visit
from .results import render_visit as render_visit
from .update import update as update
