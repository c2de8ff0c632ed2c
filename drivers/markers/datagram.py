"""The JSON that programs send by UDP or on a zenoh key, defined in docs/marker_sources.md."""

from __future__ import annotations

from collections.abc import Iterator

import msgspec

from bodyschema.drivers.ros2.messages import NANO

from .report import Fault, Report, Unusable

SCHEMA = "bodyschema.marker/1"
LARGEST_BYTES = 8192

Row = tuple[float, ...]


class Datagram(msgspec.Struct, frozen=True):
    """One position. Keys that are not named here are ignored."""

    schema: str  # name and version of this layout
    # of the marker, in m unless robot.toml says mm; null where it is not tracked
    position: tuple[float, float, float] | None = None
    stamp: float | None = None  # time of the measurement on any steady clock of the sender [s]
    seq: int | None = None  # grows by one with each datagram, whatever its body
    # (x, y, z, w) of the marker in the frame of the positions
    quaternion: tuple[float, float, float, float] | None = None
    # of the position (3 × 3), or of position and rotation (6 × 6), as rows or flat
    covariance: list[float | Row] | None = None
    body: str | None = None  # name of the body
    tracked: bool = True  # false where the position is not a measurement


_decode = msgspec.json.Decoder(Datagram).decode


def decode_datagram(payload: bytes, _: bytes = b"") -> Iterator[Report]:
    """Yield the position in a datagram; raise Unusable if it is not such JSON, or not finite."""
    if len(payload) > LARGEST_BYTES:
        raise Unusable(Fault.MALFORMED, f"{len(payload)} bytes are more than a position has")
    try:
        found = _decode(payload)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        if b"NaN" in payload or b"Infinity" in payload:
            raise Unusable(Fault.NOT_FINITE, "NaN or Infinity in the JSON") from error
        raise Unusable(Fault.MALFORMED, str(error)) from error
    if found.schema != SCHEMA:
        raise Unusable(Fault.MALFORMED, f"the schema is {found.schema[:40]!r}, not {SCHEMA!r}")
    if found.position is None and found.tracked:
        raise Unusable(Fault.MALFORMED, "there is no position")
    if found.stamp is not None and not -9e9 < found.stamp < 9e9:
        raise Unusable(Fault.DELAYED, f"the stamp {found.stamp:g} is no number of seconds")
    yield Report(
        x=found.position if found.tracked else None,
        stamp_ns=None if found.stamp is None else round(found.stamp * NANO),
        seq=found.seq,
        turn=found.quaternion,
        cov=_flat(found.covariance),
        body=found.body,
    )


def _flat(rows: list[float | Row] | None) -> tuple[float, ...] | None:
    """Return a matrix by rows, which may be nested."""
    if rows is None:
        return None
    flat = [value for row in rows for value in (row if isinstance(row, tuple) else (row,))]
    if len(flat) not in (9, 36):
        raise Unusable(Fault.COVARIANCE, f"{len(flat)} numbers, neither 3 × 3 nor 6 × 6")
    return tuple(flat)
