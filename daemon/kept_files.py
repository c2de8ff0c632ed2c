"""Files that are kept beside the one that takes their place, and names that a power cut cannot undo."""

from __future__ import annotations

import os
from pathlib import Path


def unused_name(file: Path, why: str) -> Path:
    """Return where `file` can be kept: beside it, as `pairs.sqlite.damaged-1` for the first that is damaged."""
    number = 1
    while os.path.lexists(name := file.with_name(f"{file.name}.{why}-{number}")):
        number += 1
    return name


def sync_folder(folder: Path) -> None:
    """Have the names in a folder on the disk. Without this, a power cut may undo a renaming."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
