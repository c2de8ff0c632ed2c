"""Write printable pages as files."""

from __future__ import annotations

from pathlib import Path

from bodyschema.interfaces.errors import ConfigError
from bodyschema.interfaces.whole_files import raising_write_errors, write_atomically
from bodyschema.vision.printing import Page, pdf, svg

_WRITERS = {".pdf": pdf, ".svg": svg}


def write_page(page: Page, out: Path) -> tuple[float, float]:
    """Write a page as PDF or SVG; return its horizontal and vertical ruler [mm]; raise ConfigError if writing fails."""
    writer = _WRITERS.get(out.suffix.lower())
    if writer is None:
        raise ConfigError(f"{out}: neither .pdf nor .svg", remedy="Name a file that ends so")
    with raising_write_errors(out, remedy="Name another folder"):
        write_atomically({out: writer(page)})
    return page.rulers_mm


def printed_scale(nominal_mm: float, measured_mm: float) -> float:
    """Return the ratio of a page's measured to its nominal ruler; raise ConfigError if it is implausible."""
    scale = measured_mm / nominal_mm
    if not 0.5 < scale < 2.0:
        raise ConfigError(
            f"--ruler-mm {measured_mm:g}: the ruler across of this page is nominally {nominal_mm:g} mm",
            remedy="Measure the line below the drawing, from the outer edge of its first tick to that of its last",
        )
    return scale
