"""Rank 8: the `ltgs` command."""

from .main import main as main
