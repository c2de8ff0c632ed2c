"""Settings and arrays of a learner as one byte string that describes itself.

Layout, all little-endian:

    magic     8 bytes   b"KBLEARN\\0"
    length    uint32    bytes of the header
    header    JSON, UTF-8: {"kind", "settings": {name: number or bool}, "arrays": [[name, [size, ...]], ...]}
    arrays    float64, one after the other in C order, their sizes follow from the header
    checksum  16 bytes  BLAKE2b of everything before
"""

from __future__ import annotations

import hashlib
import json
import math
import struct
from collections.abc import Mapping
from typing import Any, cast

import numpy as np

from kbmaps.arrays import FloatArray
from kbmaps.errors import ModelFormatError

_MAGIC = b"KBLEARN\0"
_PREFIX = struct.Struct("<8sI")
_CHECKSUM_BYTES = 16


def pack(kind: str, settings: Mapping[str, float], arrays: Mapping[str, FloatArray]) -> bytes:
    """One byte string; `kind` names the format and its version."""
    shapes = [[name, list(array.shape)] for name, array in arrays.items()]
    header = json.dumps({"kind": kind, "settings": dict(settings), "arrays": shapes}, separators=(",", ":")).encode()
    data = b"".join(np.ascontiguousarray(array, dtype="<f8").tobytes() for array in arrays.values())
    body = _PREFIX.pack(_MAGIC, len(header)) + header + data
    return body + hashlib.blake2b(body, digest_size=_CHECKSUM_BYTES).digest()


def unpack(kind: str, data: bytes) -> tuple[dict[str, float], dict[str, FloatArray]]:
    """Settings and arrays that `pack` was given.

    Raises:
        ModelFormatError: another kind, or damaged.
    """
    if len(data) < _PREFIX.size + _CHECKSUM_BYTES or data[:8] != _MAGIC:
        raise ModelFormatError("not a stored learner: its signature is missing")
    body = data[:-_CHECKSUM_BYTES]
    if hashlib.blake2b(body, digest_size=_CHECKSUM_BYTES).digest() != data[-_CHECKSUM_BYTES:]:
        raise ModelFormatError("the checksum does not match: the bytes are damaged or truncated")
    length = cast(int, _PREFIX.unpack_from(body)[1])
    start = _PREFIX.size + length
    try:
        header = cast(dict[str, Any], json.loads(body[_PREFIX.size : start]))
        found, settings, shapes = header["kind"], header["settings"], header["arrays"]
        sizes = [(str(name), tuple(int(size) for size in shape)) for name, shape in shapes]
        numbers = {str(name): float(value) for name, value in settings.items()}
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise ModelFormatError(f"the header does not describe a learner: {error}") from error
    if found != kind:
        raise ModelFormatError(f"the bytes hold {found!r}, not {kind!r}")
    return numbers, _arrays(body, start, sizes)


def _arrays(body: bytes, start: int, sizes: list[tuple[str, tuple[int, ...]]]) -> dict[str, FloatArray]:
    arrays: dict[str, FloatArray] = {}
    for name, shape in sizes:
        count = math.prod(shape)
        if min(shape, default=0) < 0 or start + 8 * count > len(body):
            raise ModelFormatError(f"the array {name} is longer than what is there")
        arrays[name] = np.frombuffer(body, dtype="<f8", count=count, offset=start).astype(np.float64).reshape(shape)
        start += 8 * count
    if start != len(body):
        raise ModelFormatError("there are bytes that no array accounts for")
    return arrays
