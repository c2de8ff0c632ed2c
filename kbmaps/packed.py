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
from collections.abc import Generator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, cast

import numpy as np

from kbmaps.arrays import FloatArray
from kbmaps.errors import KBMapsError, ModelFormatError

MAGIC = b"KBPACK\r\n"
VERSION = 1
_PREFIX = struct.Struct("<8sII")
_CHECKSUM_BYTES = 16
_MAX_DIMENSIONS = 4
_LARGEST_COUNT = 2**53


def pack(kind: str, fields: Mapping[str, Any], arrays: Mapping[str, FloatArray]) -> bytes:
    """Return the byte string for a model; `fields` holds JSON values, with None instead of an infinite number."""
    shapes = {name: list(array.shape) for name, array in arrays.items()}
    content = {"kind": kind, "fields": dict(fields), "arrays": shapes}
    header = json.dumps(content, separators=(",", ":"), allow_nan=False).encode()
    payload = b"".join(array.astype("<f8", copy=False).tobytes() for array in arrays.values())
    return framed(MAGIC, header, payload)


def framed(magic: bytes, header: bytes, payload: bytes) -> bytes:
    """Return magic, version, length of the header, header, payload and checksum as one byte string."""
    body = _PREFIX.pack(magic, VERSION, len(header)) + header + payload
    return body + _checksum(body)


def unframed(data: bytes, magic: bytes) -> tuple[bytes, memoryview]:
    """Return header and payload of `framed`."""
    if not isinstance(data, bytes | bytearray | memoryview):  # pyright: ignore[reportUnnecessaryIsInstance]
        raise ModelFormatError(
            f"a stored model is bytes, as to_bytes gives them and Path.read_bytes reads them; got {type(data).__name__}"
        )
    view = memoryview(data)
    if len(view) < _PREFIX.size + _CHECKSUM_BYTES:
        raise ModelFormatError(f"{len(view)} bytes are too few for a stored model")
    found, version, header_length = cast(tuple[bytes, int, int], _PREFIX.unpack_from(view))
    if found != magic:
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


def unpack(data: bytes, kind: str) -> tuple[dict[str, Any], dict[str, FloatArray]]:
    """Return fields and arrays of a model of this kind. The caller checks the contents of the fields."""
    header, payload = unframed(data, MAGIC)
    try:
        content: Any = json.loads(header, parse_float=_finite, parse_constant=_finite)
    except (ValueError, RecursionError) as error:
        raise ModelFormatError(f"the header is not JSON: {error}") from error
    parts = named(content, "the header", ("kind", "fields", "arrays"))
    if parts["kind"] != kind:
        raise ModelFormatError(f"a stored {kind} was expected; this is something else")
    if not isinstance(parts["fields"], dict) or not isinstance(parts["arrays"], dict):
        raise ModelFormatError("the header's fields or arrays are not an object")
    return cast(dict[str, Any], parts["fields"]), _arrays(cast(dict[str, Any], parts["arrays"]), payload)


def named(value: Any, what: str, keys: Sequence[str]) -> dict[str, Any]:
    """Return `value` if it is an object with exactly these keys."""
    if not isinstance(value, dict) or set(cast(dict[str, Any], value)) != set(keys):
        raise ModelFormatError(f"{what} must be an object with the keys {', '.join(keys)}")
    return cast(dict[str, Any], value)


@contextmanager
def restoring(what: str) -> Generator[None]:
    """Convert errors while restoring `what` from fields and arrays to ModelFormatError.

    Outside data may be missing, of another type, too large, or an impossible setting of a model.
    """
    try:
        yield
    except ModelFormatError:
        raise
    except (ArithmeticError, KeyError, MemoryError, TypeError, ValueError, KBMapsError) as error:
        raise ModelFormatError(f"the bytes do not describe {what}: {error}") from error


def complete(arrays: Mapping[str, FloatArray], always: Sequence[str], *parts: Sequence[str]) -> None:
    """Raise ModelFormatError unless the arrays are exactly `always` plus complete parts."""
    expected = set(always)
    for part in parts:
        expected |= set(part) if any(name in arrays for name in part) else set()
    if set(arrays) != expected:
        raise ModelFormatError(f"the arrays must be {', '.join(sorted(expected))}; got {', '.join(sorted(arrays))}")


def numbers(fields: Mapping[str, Any]) -> dict[str, float]:
    """Return fields that are all numbers."""
    return {name: number(value, f"the field {name}") for name, value in fields.items()}


def number(value: Any, what: str) -> float:
    """Return `value` if it is a number."""
    if type(value) not in (int, float):
        raise ModelFormatError(f"{what} is not a number")
    return float(value)


def count(value: Any, what: str) -> int:
    """Return `value` if it is a whole number from 0 to 2^53, the range of every JSON reader."""
    if type(value) is not int or not 0 <= value <= _LARGEST_COUNT:
        raise ModelFormatError(f"{what} is not a whole number from 0 to {_LARGEST_COUNT}")
    return value


def flag(value: Any, what: str) -> bool:
    """Return `value` if it is true or false."""
    if type(value) is not bool:
        raise ModelFormatError(f"{what} is neither true nor false")
    return value


def unless_infinite(value: float) -> float | None:
    """Return a number for JSON: None if it is infinite."""
    return None if math.isinf(value) else value


def or_infinite(value: Any, what: str) -> float:
    """Return the number from `unless_infinite`."""
    return math.inf if value is None else number(value, what)


def _arrays(shapes: dict[str, Any], payload: memoryview) -> dict[str, FloatArray]:
    arrays: dict[str, FloatArray] = {}
    begin = 0
    for name, entry in shapes.items():
        sizes = cast(list[Any], entry) if isinstance(entry, list) else []
        if not 1 <= len(sizes) <= _MAX_DIMENSIONS or not all(type(size) is int and size >= 0 for size in sizes):
            raise ModelFormatError("an array has an impossible shape")
        shape = cast(list[int], sizes)
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


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{text} is not a finite number")
    return value


def _checksum(body: bytes | memoryview) -> bytes:
    return hashlib.blake2b(body, digest_size=_CHECKSUM_BYTES).digest()
