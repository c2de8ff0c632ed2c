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

import json
import math
from collections.abc import Mapping, Sequence
from typing import Any, cast

import numpy as np

from kbmaps.arrays import FloatArray
from kbmaps.errors import ModelFormatError
from kbmaps.maps.basis import PARAMETER_NAMES, BasisKind, JointBasis, parse_bases
from kbmaps.packed import framed, named, unframed

MAGIC = b"KBMAP\r\n\0"
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
    return framed(MAGIC, header, net.astype("<f8", copy=False).tobytes())


def decode(data: bytes) -> tuple[tuple[JointBasis, ...], FloatArray, dict[str, str]]:
    """Return bases, net and metadata from a byte string."""
    header, payload = unframed(data, MAGIC)
    bases, outputs, metadata = _parse_header(header)
    shape = (outputs, *(basis.size for basis in bases))
    expected = 8 * math.prod(shape)
    if len(payload) != expected:
        raise ModelFormatError(f"the header announces a net of {expected} bytes, there are {len(payload)}")
    net = np.frombuffer(payload, dtype="<f8").astype(np.float64).reshape(shape)
    if not np.isfinite(net).all():
        raise ModelFormatError("the net holds NaN or infinite values")
    return bases, net, metadata


def _parse_header(header: bytes) -> tuple[tuple[JointBasis, ...], int, dict[str, str]]:
    try:
        content: Any = json.loads(header)
    except (ValueError, RecursionError) as error:
        raise ModelFormatError(f"the header is not JSON: {error}") from error
    fields = named(content, "the header", ("bases", "outputs", "metadata"))
    described, outputs = fields["bases"], fields["outputs"]
    if not isinstance(described, list):
        raise ModelFormatError("the header's bases are not a list")
    entries = cast(list[Any], described)
    if not 1 <= len(entries) <= _MAX_JOINTS:
        raise ModelFormatError(f"the header describes {len(entries)} joints; 1 to {_MAX_JOINTS} are possible")
    if type(outputs) is not int or outputs not in _ALLOWED_OUTPUTS:
        raise ModelFormatError(f"outputs must be one of {_ALLOWED_OUTPUTS}")
    return parse_bases([_listed(entry) for entry in entries]), outputs, _parse_metadata(fields["metadata"])


def _listed(entry: Any) -> list[Any]:
    """Return a basis of the header in the form of `parse_bases`."""
    fields = named(entry, "a basis", ("kind", "parameters"))
    kind = fields["kind"]
    if not isinstance(kind, str) or kind not in PARAMETER_NAMES:
        raise ModelFormatError("a basis is of no known kind")
    names = PARAMETER_NAMES[cast(BasisKind, kind)]
    values = named(fields["parameters"], f"the parameters of a {kind} basis", names)
    return [kind, *(values[name] for name in names)]


def _parse_metadata(entry: Any) -> dict[str, str]:
    if not isinstance(entry, dict):
        raise ModelFormatError("the metadata is not an object")
    texts = cast(dict[str, Any], entry)
    if not all(isinstance(text, str) for text in texts.values()):
        raise ModelFormatError("the metadata holds something else than texts")
    return dict(texts)
