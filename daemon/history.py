"""The stored pairs, answered over zenoh."""

from __future__ import annotations

from interfaces.errors import RequestError

from .bus import Request
from .store import PairReader
from .wire import PairsReply, encode, pair_to_wire

LARGEST_REPLY = 1000
_LARGEST_SEQ = 2**62


def answer_pairs(reader: PairReader, request: Request) -> bytes:
    """`pairs?from=SEQ;to=SEQ`: at most `LARGEST_REPLY` stored pairs in order, both bounds inclusive and optional.

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
    # The newest number is read after the pairs: a reader that sees it knows that nothing before it is missing.
    pairs = reader.read(first, to, LARGEST_REPLY)
    reply = PairsReply(reader.identity, reader.last_seq(), [pair_to_wire(pair) for pair in pairs])
    return encode(reply, request.encoding)


def _sequence_number(request: Request, name: str, default: int) -> int:
    text = request.parameters.get(name)
    if text is None:
        return default
    if not (text.isascii() and text.isdigit() and len(text) < 20 and 1 <= int(text) <= _LARGEST_SEQ):
        raise RequestError(f"{name}={text!r} is not a sequence number; they are whole numbers from 1")
    return int(text)
