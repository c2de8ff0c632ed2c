"""A pair as a row of the store: numbers as JSON, which gives every one of them back exactly."""

from __future__ import annotations

from typing import Any

import msgspec

from interfaces.covariance import from_upper, upper_triangle
from interfaces.records import Pair, frozen_array

# Stores of schemas 1 and 2 have these alone.
COLUMNS_BEFORE_ORIENTATION = "seq, segment, t, utc, q, x, cov, centres_px"
COLUMNS = f"{COLUMNS_BEFORE_ORIENTATION}, R, cov_R"


def row_of(pair: Pair) -> tuple[Any, ...]:
    """The values of `COLUMNS`."""
    arrays = (as_json(pair.q.tolist()), as_json(pair.x.tolist()), as_json(upper_triangle(pair.cov)))
    centres = None if pair.centres_px is None else as_json(pair.centres_px)
    turn = None if pair.R is None else as_json(pair.R.tolist())
    cov_turn = None if pair.cov_R is None else as_json(upper_triangle(pair.cov_R))
    return (pair.seq, pair.segment, pair.t, pair.utc, *arrays, centres, turn, cov_turn)


def pair_of(store: str, row: tuple[Any, ...]) -> Pair:
    """The pair of a row of `COLUMNS`, or of `COLUMNS_BEFORE_ORIENTATION`."""
    seq, segment, t, utc, q, x, upper, centres, *turned = row
    turn, cov_turn = turned or (None, None)
    return Pair(
        store=store,
        seq=seq,
        segment=segment,
        t=t,
        utc=utc,
        q=frozen_array(msgspec.json.decode(q)),
        x=frozen_array(msgspec.json.decode(x)),
        cov=frozen_array(from_upper(msgspec.json.decode(upper))),
        centres_px=None if centres is None else tuple(msgspec.json.decode(centres)),
        R=None if turn is None else frozen_array(msgspec.json.decode(turn)),
        cov_R=None if cov_turn is None else frozen_array(from_upper(msgspec.json.decode(cov_turn))),
    )


def as_json(numbers: object) -> str:
    """Numbers, or what holds them, in a column."""
    return msgspec.json.encode(numbers).decode()
