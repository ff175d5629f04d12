"""Rank 6: the `ltgs` command."""

from .main import main as main
