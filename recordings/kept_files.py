"""Keep replaced files next to their replacements, and make renames durable."""

from __future__ import annotations

import os
from pathlib import Path


def unused_name(file: Path, why: str) -> Path:
    """Return a free name next to `file`, such as `pairs.sqlite.damaged-1` for the first damaged one."""
    number = 1
    while os.path.lexists(name := file.with_name(f"{file.name}.{why}-{number}")):
        number += 1
    return name


def sync_folder(folder: Path) -> None:
    """Sync a folder's entries to disk. Without this, a power cut may undo a rename."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
