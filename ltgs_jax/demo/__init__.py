"""Rank 2: the built-in captures, ray-cast with known truth."""

from .capture import make_capture as make_capture
from .capture import object_ids as object_ids
from .story import SCENES as SCENES
