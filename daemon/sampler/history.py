"""Stored pairs over zenoh: answered by the sampler, read by the learner."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import msgspec

from bodyschema.daemon.transport.session import Request
from bodyschema.daemon.transport.wire import PairMessage, PairsReply, decode, encode, pairs_to_wire
from bodyschema.interfaces.errors import RequestError
from bodyschema.recordings.store.store import PairReader

LARGEST_REPLY = 1000
_LARGEST_SEQ = 2**62


@dataclass(frozen=True, slots=True)
class Unreadable:
    """An invalid stored pair; `why` is the reason."""

    seq: int
    why: str


@dataclass(frozen=True, slots=True)
class Page:
    """A `PairsReply` in which one invalid pair does not spoil the others."""

    store: str
    last_seq: int
    pairs: Sequence[PairMessage | Unreadable]


class _RawPage(msgspec.Struct, frozen=True):
    store: str
    last_seq: int
    pairs: list[msgspec.Raw]


class _Numbered(msgspec.Struct, frozen=True):
    seq: Annotated[int, msgspec.Meta(ge=1)]


def read_page(payload: bytes) -> Page:
    """Return the page in a JSON reply of the sampler.

    Raises:
        RequestError: it is not a page, or has a pair without a number.
    """
    page = decode(payload, _RawPage)
    return Page(page.store, page.last_seq, [_read(bytes(raw)) for raw in page.pairs])


def _read(raw: bytes) -> PairMessage | Unreadable:
    try:
        return decode(raw, PairMessage)
    except RequestError as error:
        seq = decode(raw, _Numbered).seq
        return Unreadable(seq, f"sample {seq} is {error}")


def answer_pairs(reader: PairReader, request: Request) -> bytes:
    """Answer `pairs?from=SEQ;to=SEQ` with at most `LARGEST_REPLY` stored pairs, bounds inclusive and optional.

    Raises:
        RequestError: an unknown parameter, or one that is not a sequence number.
    """
    unknown = [name for name in request.parameters if name not in ("from", "to")]
    if unknown:
        raise RequestError(f"unknown parameter {unknown[0]!r}. Known are: from, to (as in pairs?from=1;to=100)")
    first = _sequence_number(request, "from", 1)
    to = _sequence_number(request, "to", _LARGEST_SEQ)
    if to < first:
        raise RequestError(f"from={first} is after to={to}")
    # Read the newest number after the pairs: a client that sees it knows that nothing before it is missing.
    pairs = reader.read(first, to, LARGEST_REPLY)
    reply = PairsReply(reader.identity, reader.last_seq(), pairs_to_wire(pairs))
    return encode(reply, request.encoding)


def _sequence_number(request: Request, name: str, default: int) -> int:
    text = request.parameters.get(name)
    if text is None:
        return default
    if not (text.isascii() and text.isdigit() and len(text) < 20 and 1 <= int(text) <= _LARGEST_SEQ):
        raise RequestError(f"{name}={text!r} is not a sequence number; they are whole numbers from 1")
    return int(text)
