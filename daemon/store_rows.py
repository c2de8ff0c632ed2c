"""A pair as a row of the store: numbers as JSON, which gives every one of them back exactly."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np

from interfaces.records import FloatArray, Pair, frozen_array

# Stores of schemas 1 and 2 have these alone.
COLUMNS_BEFORE_ORIENTATION = "seq, segment, t, utc, q, x, cov, centres_px"
COLUMNS = f"{COLUMNS_BEFORE_ORIENTATION}, R, cov_R"
_UPPER = np.triu_indices(3)


def row_of(pair: Pair) -> tuple[Any, ...]:
    """The values of `COLUMNS`."""
    arrays = (_json(pair.q.tolist()), _json(pair.x.tolist()), _json(pair.cov[_UPPER].tolist()))
    centres = None if pair.centres_px is None else _json(pair.centres_px)
    turn = None if pair.R is None else _json(pair.R.tolist())
    cov_turn = None if pair.cov_R is None else _json(pair.cov_R[_UPPER].tolist())
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
        cov=_symmetric(upper),
        centres_px=None if centres is None else tuple(msgspec.json.decode(centres)),
        R=None if turn is None else frozen_array(msgspec.json.decode(turn)),
        cov_R=None if cov_turn is None else _symmetric(cov_turn),
    )


def _symmetric(upper: str) -> FloatArray:
    cov = np.zeros((3, 3))
    cov[_UPPER] = msgspec.json.decode(upper)
    return frozen_array(cov + np.triu(cov, 1).T)


def _json(numbers: object) -> str:
    return msgspec.json.encode(numbers).decode()
