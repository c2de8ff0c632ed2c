"""Calibration report: report.html, a single file that needs no network."""

from .page import page

__all__ = ["page"]
