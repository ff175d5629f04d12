"""Rank 7: the browser viewer."""

from .server import serve as serve
from .server import start as start
