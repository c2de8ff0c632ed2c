"""Read SQLite's write-ahead log, to detect commits after a damaged place, which SQLite drops silently."""

from __future__ import annotations

import struct
from pathlib import Path

# Header of the file and of each frame: magic, version, page size, sequence, two salts, checksum; page, size, salts,
# checksum.
_HEADER, _FRAME = struct.Struct(">6I8x"), struct.Struct(">4I8x")


def commits(store: Path) -> list[bool]:
    """Return for each frame of a store's log whether it ended a transaction, up to the first frame of an older log.

    A missing log, or one with a damaged header, has no frames.
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
