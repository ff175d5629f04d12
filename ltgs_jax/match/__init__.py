"""Rank 3: one identity per object, across views and across visits."""

from .hull import Cone as Cone
from .hull import Grid as Grid
from .hull import carve as carve
from .hull import grid_around as grid_around
from .instances import Instance as Instance
from .instances import MatchConfig as MatchConfig
from .instances import find_instances as find_instances
