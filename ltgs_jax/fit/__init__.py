"""Rank 4: optimisation of the initial scene and of the whole chronology."""

from .chronology import LongConfig as LongConfig
from .chronology import fit_chronology as fit_chronology
from .chronology import template_diameter as template_diameter
from .initial import FitResult as FitResult
from .initial import InitialConfig as InitialConfig
from .initial import fit_initial as fit_initial
from .initial import splats_from_points as splats_from_points
from .local import Windows as Windows
from .local import fit_local as fit_local
from .loss import photometric_loss as photometric_loss
from .mend import MendConfig as MendConfig
from .mend import mend_background as mend_background
from .views import Budget as Budget
from .views import StreamedView as StreamedView
from .views import View as View
from .views import VisitView as VisitView
from .views import halved as halved
