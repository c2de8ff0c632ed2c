"""SQLite's write-ahead log: what was committed behind a damaged place, which SQLite drops without a word."""

from __future__ import annotations

import struct
from pathlib import Path

# Of the file and of each frame: magic, version, page size, sequence, two salts, checksum; page, size, salts, checksum.
_HEADER, _FRAME = struct.Struct(">6I8x"), struct.Struct(">4I8x")


def commits(store: Path) -> list[bool]:
    """Return for each frame of the log of a store whether it ended a transaction, up to the first of an older log.

    A log that is not there, or whose header is damaged, has no frames.
    """
    found: list[bool] = []
    try:
        with store.with_name(f"{store.name}-wal").open("rb") as log:
            header = log.read(_HEADER.size)
            if len(header) < _HEADER.size:
                return []
            _, _, page_bytes, _, *salts = _HEADER.unpack(header)
            while len(frame := log.read(_FRAME.size)) == _FRAME.size:
                _, pages, *own = _FRAME.unpack(frame)
                if own != salts:
                    break
                found.append(pages > 0)
                log.seek(page_bytes, 1)
    except OSError:
        return []
    return found
