"""Rank 6: the page of results."""

from .page import write_report as write_report
