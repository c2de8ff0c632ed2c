"""Write files that appear complete or not at all, whatever the disk does."""

from __future__ import annotations

import os
import secrets
from collections.abc import Mapping
from pathlib import Path


def write_whole(contents: Mapping[Path, bytes]) -> None:
    """Write files, replacing those that are there: all of them once all are on the disk, else none.

    Raises:
        OSError: one of them cannot be written; nothing was changed.
    """
    token = secrets.token_hex(4)
    parts = {file.with_name(f".{token}.{place}.part"): file for place, file in enumerate(contents)}
    try:
        for part, file in parts.items():
            with part.open("xb") as stream:
                stream.write(contents[file])
                stream.flush()
                os.fsync(stream.fileno())
        for part, file in parts.items():
            os.replace(part, file)
    finally:
        for part in parts:
            part.unlink(missing_ok=True)
