"""Convert a pair to a row of the store and back: numbers as JSON, which preserves them exactly, and a row checksum."""

from __future__ import annotations

import math
import zlib
from typing import Any, NamedTuple

import msgspec

from bodyschema.interfaces.covariance import Upper, upper_triangle
from bodyschema.interfaces.records import FloatArray, Pair, frozen_array

# The columns of each table that the checksum covers, in its order.
COLUMNS = {
    "pairs": "seq, session, segment, t, utc, q, x, cov, centres_px, R, cov_R",
    "devices": "id, session, from_seq, utc, record",
    "sessions": "id, started_utc, robot_toml, urdf, config, version, host",
}
# The angles of 60 joints take 1.5 kB. A longer text was not written by a sampler, and is not decoded.
LARGEST_ANGLES_BYTES = 2**16

_angles = msgspec.json.Decoder(list[float])
_three = msgspec.json.Decoder(tuple[float, float, float])
_four = msgspec.json.Decoder(tuple[float, float, float, float])
_six = msgspec.json.Decoder(Upper)
_packed = msgspec.msgpack.Encoder()


class DamagedRow(ValueError):
    """The disk returned other data than was written."""


class Checked(NamedTuple):
    """The fields of a pair needed for checking a whole store."""

    seq: int
    session: int
    q: list[float]


def row_of(pair: Pair, session: int) -> tuple[Any, ...]:
    arrays = (as_json(pair.q.tolist()), as_json(pair.x.tolist()), as_json(upper_triangle(pair.cov)))
    centres = None if pair.centres_px is None else as_json(pair.centres_px)
    turn = None if pair.R is None else as_json(pair.R.tolist())
    cov_turn = None if pair.cov_R is None else as_json(upper_triangle(pair.cov_R))
    # SQLite does not keep the sign of a zero.
    return (pair.seq, session, pair.segment, pair.t + 0.0, pair.utc, *arrays, centres, turn, cov_turn)


def sealed(row: tuple[Any, ...]) -> tuple[Any, ...]:
    """Return the row with its checksum appended."""
    return *row, checksum(tuple(value.encode() if isinstance(value, str) else value for value in row))


def checksum(row: tuple[Any, ...]) -> int:
    """Return the CRC-32 of a row whose texts are bytes.

    It detects each single flipped bit and each changed character with certainty; a hash does so only with high
    probability.
    """
    return zlib.crc32(_packed.encode(row))


def require_sound(row: tuple[Any, ...]) -> None:
    """Raise DamagedRow unless the last value is the checksum of the others, given as SQLite returns them."""
    if checksum(row[:-1]) != row[-1]:
        raise DamagedRow


def decoded(row: tuple[Any, ...], joints: int) -> tuple[Any, ...]:
    """Return the values of a row of `pairs` without its checksum, texts as bytes: numbers and lists of numbers.

    Raises:
        DamagedRow: no sampler with `joints` joints writes such a row.
    """
    seq, session, segment, t, utc, q, x, upper, centres, turn, cov_turn = row
    try:
        if len(q) > LARGEST_ANGLES_BYTES or seq < 1:
            raise DamagedRow
        angles = _angles.decode(q)
        values = (
            *(seq, session, segment, t, utc.decode(), angles, _three.decode(x), _six.decode(upper)),
            None if centres is None else _four.decode(centres),
            None if turn is None else _four.decode(turn),
            None if cov_turn is None else _six.decode(cov_turn),
        )
    except (AttributeError, TypeError, UnicodeDecodeError, msgspec.DecodeError, RecursionError) as error:
        raise DamagedRow from error
    if len(angles) != joints or type(segment) is not int or type(t) is not float or not math.isfinite(t):
        raise DamagedRow
    return values


def pair_of(store: str, row: tuple[Any, ...], joints: int) -> Pair:
    """Return the pair of a row as for `decoded`, whose errors it raises."""
    seq, _, segment, t, utc, q, x, upper, centres, turn, cov_turn = decoded(row, joints)
    return Pair(
        store=store,
        seq=seq,
        segment=segment,
        t=t,
        utc=utc,
        q=frozen_array(q),
        x=frozen_array(x),
        cov=_covariance(upper),
        centres_px=centres,
        R=None if turn is None else frozen_array(turn),
        cov_R=None if cov_turn is None else _covariance(cov_turn),
    )


def checked(row: tuple[Any, ...], joints: int) -> Checked:
    """Decode a row whose checksum is sound, like `pair_of` but in a fifth of the time.

    Raises:
        DamagedRow: it has another number of joint angles.
    """
    try:
        q = _angles.decode(row[5])
    except (TypeError, msgspec.DecodeError, RecursionError) as error:
        raise DamagedRow from error
    if len(q) != joints:
        raise DamagedRow
    return Checked(row[0], row[1], q)


def as_json(numbers: object) -> str:
    """Return numbers, or containers of numbers, as a column's JSON text."""
    return msgspec.json.encode(numbers).decode()


def _covariance(upper: Upper) -> FloatArray:
    xx, xy, xz, yy, yz, zz = upper
    return frozen_array(((xx, xy, xz), (xy, yy, yz), (xz, yz, zz)))
