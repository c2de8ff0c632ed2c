"""State of the learner as plain values and arrays: the contents of a checkpoint."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import msgspec
import numpy as np

from bodyschema.interfaces.errors import BodyschemaError
from bodyschema.interfaces.records import FloatArray, PairLimits
from bodyschema.learning.model_bank import PRIOR
from bodyschema.learning.orientation import OrientationState
from bodyschema.learning.status import ChangeRecord, CurvePoint
from bodyschema.learning.uncertainty import UncertaintyState

BEFORE_PREFIX = "before/"  # prefix of the arrays of the state before a change
NET_PREFIX = "net_"  # prefix of stored nets
PAIR_ARRAYS = ("q", "x", "cov", "turns")  # arrays with a row for each kept pair


MAX_CURVE_POINTS = 400  # of the learning curve


class StateError(BodyschemaError):
    """A stored state does not fit this learner."""


class Counters(msgspec.Struct, kw_only=True):
    """All counters. `pairs` are learnt online, each once; `last_seq` is the newest of them."""

    store: str | None = None  # identity of the store the pairs came from
    pairs: int = 0
    last_seq: int = 0
    since_change: int = 0  # pairs since the last change, or since the beginning
    replayed: int = 0
    refused: int = 0
    gaps_recovered: int = 0
    changes: int = 0  # changes of the tool, or of another part, that were reported or detected
    doubted: int = 0  # pairs that looked like gross outliers
    missed: int = 0  # pairs that the sampler no longer kept when they were requested


class LearningHeader(msgspec.Struct, kw_only=True):
    """Part of the state without arrays. Fields with a default belong to a regime."""

    fingerprint: str  # of the nominal model and the tolerances it started from
    counters: Counters
    claims: UncertaintyState  # uncertainties and errors of the models
    curve: list[CurvePoint]
    curve_stride: int
    kept_of: int  # number of pairs since the prior; the newest of them are kept
    # number of pairs at which an unknown frame, or the tool after a change, is fitted again; None for never
    next_fit: int | None
    first_fit: bool  # True if that will be the first fit
    answering: str = PRIOR  # the model that answers
    doubted_in_a_row: int = 0  # number of consecutive outliers up to now
    replays_due: float = 0.0  # replay steps that are still due
    # position of the replay: epochs begun, number of pairs of the current epoch, and number of these that were replayed
    replay_position: tuple[int, int, int] = (0, 0, 0)
    # prior of the chain before the first of these pairs, as bytes; None before the alignment
    belief: bytes | None = None
    residual: bytes | None = None  # prior of the arm beyond that, as bytes; None without any
    # state of the orientation models; None in a checkpoint of an older version
    orientation: OrientationState | None = None
    change: ChangeRecord | None = None  # the last change; None if there was none
    # the state before it, for rollback, or None. Its arrays' names begin with `BEFORE_PREFIX`.
    before: LearningHeader | None = None


@dataclass(frozen=True)
class LearningState:
    """State of a learner.

    `arrays` are the nets by model, the kept pairs, the consecutive outliers, the arrays of the uncertainties, and the
    inputs of a tool fit.
    """

    header: LearningHeader
    arrays: Mapping[str, FloatArray]

    @property
    def before(self) -> LearningState | None:
        """State before the last change, or None."""
        if self.header.before is None:
            return None
        arrays = {
            name.removeprefix(BEFORE_PREFIX): each
            for name, each in self.arrays.items()
            if name.startswith(BEFORE_PREFIX)
        }
        return LearningState(self.header.before, arrays)

    def with_before(self, before: LearningState | None) -> LearningState:
        """Return the same state with another one to roll back to."""
        if before is None:
            return self
        header = msgspec.structs.replace(self.header, before=before.header)
        return LearningState(
            header, {**self.arrays, **{BEFORE_PREFIX + name: each for name, each in before.arrays.items()}}
        )

    def invalid_array(self) -> str | None:
        """Return the name of a net, or of an array of pairs, with impossible values; None if all are valid."""
        nets = dict.fromkeys((name for name in self.arrays if name.startswith(NET_PREFIX)), np.inf)
        limits = {**nets, "q": PairLimits.largest_q, "x": PairLimits.farthest_m}
        for name, limit in limits.items():
            if not (np.isfinite(self.arrays[name]).all() and (np.abs(self.arrays[name]) <= limit).all()):
                return name
        return None


class Curve:
    """Points of the learning curve, at most `MAX_CURVE_POINTS`, evenly spread over the pairs."""

    def __init__(self, points: list[CurvePoint] | None = None, stride: int = 1) -> None:
        self._points = list(points or [])
        self.stride = stride

    @property
    def points(self) -> list[CurvePoint]:
        return list(self._points)

    def add(self, pairs: int, error_m: float) -> None:
        """Add the prequential error after this many pairs, unless the thinning skips it."""
        if pairs % self.stride:
            return
        self._points.append(CurvePoint(pairs, error_m))
        if len(self._points) > MAX_CURVE_POINTS:
            self.stride *= 2
            self._points = [point for point in self._points if point.pairs % self.stride == 0]
