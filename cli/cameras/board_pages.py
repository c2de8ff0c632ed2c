"""Write printable pages as files."""

from __future__ import annotations

from pathlib import Path

from bodyschema.interfaces.errors import ConfigError
from bodyschema.interfaces.whole_files import write_whole, writing
from bodyschema.vision.printing import Page, pdf, svg

_WRITERS = {".pdf": pdf, ".svg": svg}


def write_page(page: Page, out: Path) -> None:
    """Write a page as PDF or SVG; raise ConfigError if the file's ending is neither, or it cannot be written."""
    writer = _WRITERS.get(out.suffix.lower())
    if writer is None:
        raise ConfigError(f"{out}: neither .pdf nor .svg", remedy="Name a file that ends so")
    with writing(out, remedy="Name another folder"):
        write_whole({out: writer(page)})
