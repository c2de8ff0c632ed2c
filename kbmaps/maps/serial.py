"""A map as one byte string that describes itself.

Layout, all little-endian:

    magic     8 bytes   b"KBMAP\\r\\n\\0" (the line end shows a transfer that mangled text)
    version   uint32    1
    length    uint32    bytes of the header
    header    JSON, UTF-8: {"bases": [{"kind", "parameters": {...}}], "outputs", "metadata": {text: text}}
    net       float64   (outputs, m1, ..., md) in C order; its size follows from the header
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
from kbmaps.errors import BasisError, ModelFormatError
from kbmaps.maps.basis import PARAMETER_NAMES, BasisKind, JointBasis

MAGIC = b"KBMAP\r\n\0"
VERSION = 1
_PREFIX = struct.Struct("<8sII")
_CHECKSUM_BYTES = 16
# Far above any net that fits into memory, and low enough that 3^d stays a small integer.
_MAX_JOINTS = 32
_ALLOWED_OUTPUTS = (3, 12)


def encode(bases: Sequence[JointBasis], net: FloatArray, metadata: Mapping[str, str]) -> bytes:
    """Return the byte string for a net (outputs, m1, ..., md)."""
    described = [
        {"kind": basis.kind, "parameters": dict(zip(PARAMETER_NAMES[basis.kind], basis.parameters, strict=True))}
        for basis in bases
    ]
    content = {"bases": described, "outputs": net.shape[0], "metadata": dict(metadata)}
    header = json.dumps(content, sort_keys=True, separators=(",", ":")).encode()
    body = _PREFIX.pack(MAGIC, VERSION, len(header)) + header + net.astype("<f8", copy=False).tobytes()
    return body + _checksum(body)


def decode(data: bytes) -> tuple[tuple[JointBasis, ...], FloatArray, dict[str, str]]:
    """Return bases, net and metadata from a byte string.

    Raises:
        ModelFormatError: the bytes are damaged, truncated, or of another format.
    """
    if not isinstance(data, bytes | bytearray | memoryview):  # pyright: ignore[reportUnnecessaryIsInstance]
        raise ModelFormatError(f"a stored map is bytes, as to_bytes gives them; got {type(data).__name__}")
    view = memoryview(data)
    header, payload = _split(view)
    bases, outputs, metadata = _parse_header(header)
    shape = (outputs, *(basis.size for basis in bases))
    expected = 8 * math.prod(shape)
    if len(payload) != expected:
        raise ModelFormatError(f"the header announces a net of {expected} bytes, there are {len(payload)}")
    net = np.frombuffer(payload, dtype="<f8").astype(np.float64).reshape(shape)
    if not np.isfinite(net).all():
        raise ModelFormatError("the net holds NaN or infinite values")
    return bases, net, metadata


def _split(view: memoryview) -> tuple[bytes, memoryview]:
    """Return header and net, after checking magic, version, lengths and checksum."""
    if len(view) < _PREFIX.size + _CHECKSUM_BYTES:
        raise ModelFormatError(f"{len(view)} bytes are too few for a stored map")
    magic, version, header_length = cast(tuple[bytes, int, int], _PREFIX.unpack_from(view))
    if magic != MAGIC:
        raise ModelFormatError("not a stored map: the first eight bytes are not its signature")
    if version != VERSION:
        raise ModelFormatError(f"format version {version} is not known here (this code reads {VERSION})")
    body, checksum = view[:-_CHECKSUM_BYTES], bytes(view[-_CHECKSUM_BYTES:])
    if _checksum(body) != checksum:
        raise ModelFormatError("the checksum does not match: the bytes are damaged or truncated")
    if header_length > len(body) - _PREFIX.size:
        raise ModelFormatError(f"the header claims {header_length} bytes, more than there are")
    end = _PREFIX.size + header_length
    return bytes(body[_PREFIX.size : end]), body[end:]


def _parse_header(header: bytes) -> tuple[tuple[JointBasis, ...], int, dict[str, str]]:
    try:
        content: Any = json.loads(header)
    except (ValueError, RecursionError) as error:
        raise ModelFormatError(f"the header is not JSON: {error}") from error
    fields = _object(content, "the header", ("bases", "outputs", "metadata"))
    described, outputs = fields["bases"], fields["outputs"]
    if not isinstance(described, list):
        raise ModelFormatError("the header's bases are not a list")
    entries = cast(list[Any], described)
    if not 1 <= len(entries) <= _MAX_JOINTS:
        raise ModelFormatError(f"the header describes {len(entries)} joints; 1 to {_MAX_JOINTS} are possible")
    if type(outputs) is not int or outputs not in _ALLOWED_OUTPUTS:
        raise ModelFormatError(f"outputs must be one of {_ALLOWED_OUTPUTS}")
    return tuple(_parse_basis(entry) for entry in entries), outputs, _parse_metadata(fields["metadata"])


def _parse_basis(entry: Any) -> JointBasis:
    fields = _object(entry, "a basis", ("kind", "parameters"))
    kind = fields["kind"]
    if not isinstance(kind, str) or kind not in PARAMETER_NAMES:
        raise ModelFormatError("a basis is of no known kind")
    known = cast(BasisKind, kind)
    values = _object(fields["parameters"], f"the parameters of a {known} basis", PARAMETER_NAMES[known])
    numbers = [values[name] for name in PARAMETER_NAMES[known]]
    if not all(isinstance(number, float) for number in numbers):
        raise ModelFormatError(f"the parameters of a {known} basis are not all floating-point numbers")
    try:
        return JointBasis(known, tuple(numbers))
    except BasisError as error:
        raise ModelFormatError(f"the header describes an impossible basis: {error}") from error


def _parse_metadata(entry: Any) -> dict[str, str]:
    if not isinstance(entry, dict):
        raise ModelFormatError("the metadata is not an object")
    texts = cast(dict[str, Any], entry)
    if not all(isinstance(text, str) for text in texts.values()):
        raise ModelFormatError("the metadata holds something else than texts")
    return dict(texts)


def _object(value: Any, what: str, keys: tuple[str, ...]) -> dict[str, Any]:
    if not isinstance(value, dict) or set(cast(dict[str, Any], value)) != set(keys):
        raise ModelFormatError(f"{what} must be an object with the keys {', '.join(keys) or '(none)'}")
    return cast(dict[str, Any], value)


def _checksum(body: bytes | memoryview) -> bytes:
    return hashlib.blake2b(body, digest_size=_CHECKSUM_BYTES).digest()
