"""report.html: a calibration to look at, in one file that needs no network."""

from .page import page

__all__ = ["page"]
