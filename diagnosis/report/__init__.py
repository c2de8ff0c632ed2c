"""report.html: a diagnosis to look at, in one file that needs no network."""

from .page import About, page

__all__ = ["About", "page"]
