"""Pages to print in true size: black rectangles, rulers to check the print, and some text; as PDF and SVG."""

from .pdf import pdf
from .sheet import Page
from .svg import svg

__all__ = ["Page", "pdf", "svg"]
