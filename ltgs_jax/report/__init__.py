"""Rank 6: the page of results, and a finished run read for showing."""

from .page import write_report as write_report
from .pictures import color_of as color_of
from .pictures import difference as difference
from .pictures import fitted as fitted
from .pictures import read_shown as read_shown
from .run import Run as Run
from .run import Shot as Shot
from .run import read_run as read_run
from .turntable import up_direction as up_direction
from .words import happenings as happenings
