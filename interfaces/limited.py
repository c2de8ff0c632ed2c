"""Files of which no more is read than a file of their kind can have: a device, or a file without end, says no size."""

from __future__ import annotations

from pathlib import Path

_PIECE = 2**20


def read_at_most(file: Path, most: int) -> bytes | None:
    """The bytes of `file`; None when they are more than `most`. Raises OSError when it cannot be read."""
    data = bytearray()
    with file.open("rb") as stream:
        while piece := stream.read(_PIECE):  # to ask for `most` at once would take the room for it
            data += piece
            if len(data) > most:
                return None
    return bytes(data)
