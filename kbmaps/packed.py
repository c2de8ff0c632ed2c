"""Numbers and arrays of a model as one byte string that describes itself.

Layout, all little-endian:

    magic     8 bytes   b"KBPACK\\r\\n" (the line end shows a transfer that mangled text)
    version   uint32    1
    length    uint32    bytes of the header
    header    JSON, UTF-8: {"kind": text, "fields": {...}, "arrays": {name: shape}}
    arrays    float64   one after the other in the header's order, each in C order
    checksum  16 bytes  BLAKE2b of everything before
"""

from __future__ import annotations

import hashlib
import json
import math
import struct
from collections.abc import Mapping, Sequence
from typing import Any, cast

import numpy as np

from kbmaps.arrays import FloatArray
from kbmaps.errors import ModelFormatError

MAGIC = b"KBPACK\r\n"
VERSION = 1
_PREFIX = struct.Struct("<8sII")
_CHECKSUM_BYTES = 16
_MAX_DIMENSIONS = 4


def pack(kind: str, fields: Mapping[str, Any], arrays: Mapping[str, FloatArray]) -> bytes:
    """The byte string for a model of this kind; `fields` holds what JSON can."""
    shapes = {name: list(array.shape) for name, array in arrays.items()}
    header = json.dumps({"kind": kind, "fields": dict(fields), "arrays": shapes}, separators=(",", ":")).encode()
    payload = b"".join(array.astype("<f8", copy=False).tobytes() for array in arrays.values())
    body = _PREFIX.pack(MAGIC, VERSION, len(header)) + header + payload
    return body + _checksum(body)


def unpack(data: bytes, kind: str) -> tuple[dict[str, Any], dict[str, FloatArray]]:
    """Fields and arrays of a model of this kind. What the fields hold is for the caller to check.

    Raises:
        ModelFormatError: the bytes are damaged, truncated, of another kind, or something else.
    """
    header, payload = _split(memoryview(data))
    try:
        content: Any = json.loads(header)
    except (ValueError, RecursionError) as error:
        raise ModelFormatError(f"the header is not JSON: {error}") from error
    parts = named(content, "the header", ("kind", "fields", "arrays"))
    if parts["kind"] != kind:
        raise ModelFormatError(f"a stored {kind} was expected; this is something else")
    if not isinstance(parts["fields"], dict) or not isinstance(parts["arrays"], dict):
        raise ModelFormatError("the header's fields or arrays are not an object")
    return cast(dict[str, Any], parts["fields"]), _arrays(cast(dict[str, Any], parts["arrays"]), payload)


def named(value: Any, what: str, keys: Sequence[str]) -> dict[str, Any]:
    """`value` if it is an object with exactly these keys. Raises ModelFormatError."""
    if not isinstance(value, dict) or set(cast(dict[str, Any], value)) != set(keys):
        raise ModelFormatError(f"{what} must be an object with the keys {', '.join(keys)}")
    return cast(dict[str, Any], value)


def numbers(fields: Mapping[str, Any]) -> dict[str, float]:
    """Fields that are all numbers. Raises ModelFormatError."""
    for name, value in fields.items():
        if type(value) not in (int, float):
            raise ModelFormatError(f"the field {name} is not a number")
    return {name: float(value) for name, value in fields.items()}


def _split(view: memoryview) -> tuple[bytes, memoryview]:
    """Header and arrays, once magic, version, lengths and checksum are right."""
    if len(view) < _PREFIX.size + _CHECKSUM_BYTES:
        raise ModelFormatError(f"{len(view)} bytes are too few for a stored model")
    magic, version, header_length = cast(tuple[bytes, int, int], _PREFIX.unpack_from(view))
    if magic != MAGIC:
        raise ModelFormatError("not a stored model: the first eight bytes are not its signature")
    if version != VERSION:
        raise ModelFormatError(f"format version {version} is not known here (this code reads {VERSION})")
    body, checksum = view[:-_CHECKSUM_BYTES], bytes(view[-_CHECKSUM_BYTES:])
    if _checksum(body) != checksum:
        raise ModelFormatError("the checksum does not match: the bytes are damaged or truncated")
    end = _PREFIX.size + header_length
    if end > len(body):
        raise ModelFormatError(f"the header claims {header_length} bytes, more than there are")
    return bytes(body[_PREFIX.size : end]), body[end:]


def _arrays(shapes: dict[str, Any], payload: memoryview) -> dict[str, FloatArray]:
    arrays: dict[str, FloatArray] = {}
    begin = 0
    for name, entry in shapes.items():
        shape = _shape(entry)
        end = begin + 8 * math.prod(shape)
        if end > len(payload):
            raise ModelFormatError("the header announces more numbers than there are")
        array = np.frombuffer(payload[begin:end], dtype="<f8").astype(np.float64).reshape(shape)
        if np.isinf(array).any():
            raise ModelFormatError("an array holds infinite values")
        arrays[name], begin = array, end
    if begin != len(payload):
        raise ModelFormatError(f"the header announces {begin} bytes of numbers, there are {len(payload)}")
    return arrays


def _shape(entry: Any) -> list[int]:
    sizes = cast(list[Any], entry) if isinstance(entry, list) else []
    if not 1 <= len(sizes) <= _MAX_DIMENSIONS or not all(type(size) is int and size >= 0 for size in sizes):
        raise ModelFormatError("an array has an impossible shape")
    return cast(list[int], sizes)


def _checksum(body: bytes | memoryview) -> bytes:
    return hashlib.blake2b(body, digest_size=_CHECKSUM_BYTES).digest()
