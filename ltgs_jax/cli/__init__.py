"""Rank 8: the `ltgs` command."""

from .main import entry as entry
from .main import main as main
