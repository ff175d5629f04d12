"""Rank 2: the built-in captures, ray-cast with known truth."""

from .capture import make_capture as make_capture
from .story import SCENES as SCENES
