"""Rank 7: the `ltgs` command."""

from .main import main as main
