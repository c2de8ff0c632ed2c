"""Write report.html: a diagnosis in one file that needs no network."""

from .page import About, page

__all__ = ["About", "page"]
