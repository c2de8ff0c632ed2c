"""A page as SVG, in true size."""

from __future__ import annotations

from xml.sax.saxutils import escape

from .sheet import Page, Text


def svg(page: Page) -> bytes:
    """Return the bytes of the file."""
    width, height = page.size_mm
    black = "".join(
        f'<rect x="{r.x_mm:.4f}" y="{r.y_mm:.4f}" width="{r.width_mm:.4f}" height="{r.height_mm:.4f}"/>\n'
        for r in page.rectangles
    )
    texts = "".join(map(_text, page.texts))
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width:g}mm" height="{height:g}mm" '
        f'viewBox="0 0 {width:g} {height:g}">\n<rect width="{width:g}" height="{height:g}" fill="#fff"/>\n'
        f'<g fill="#000" shape-rendering="crispEdges">\n{black}</g>\n<g fill="#000">{texts}</g>\n</svg>\n'
    ).encode()


def _text(text: Text) -> str:
    turn = f' transform="rotate(-90 {text.x_mm:.4f} {text.y_mm:.4f})"' if text.turned else ""
    return (
        f'<text x="{text.x_mm:.4f}" y="{text.y_mm:.4f}" font-family="Helvetica,Arial,sans-serif" '
        f'font-size="{text.size_mm:g}"{turn}>{escape(text.text)}</text>\n'
    )
