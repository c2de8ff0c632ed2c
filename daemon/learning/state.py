"""The learner's state as plain values and arrays: what a checkpoint holds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import msgspec
import numpy as np

from bodyschema.daemon.status import CurvePoint
from bodyschema.interfaces.errors import BodyschemaError
from bodyschema.interfaces.records import FARTHEST_M, LARGEST_Q, FloatArray

from .change import ChangeRecord
from .claims import ClaimsState
from .members import PRIOR
from .orientation import OrientationState

# Names of the arrays of the state before a change begin with this.
BEFORE = "before/"
# Names of stored nets begin with this.
NET = "net_"


class StateError(BodyschemaError):
    """A stored state does not fit this learner."""


class Counters(msgspec.Struct, kw_only=True):
    """Everything that is counted. `pairs` are learnt online, each once; `last_seq` is the newest of them.

    Attributes:
        store: identity of the store the pairs came from.
        since_change: pairs since the last change, or since the beginning.
        changes: changes of the tool, or of something else, that were told or found.
        doubted: pairs that looked like gross outliers.
        missed: pairs that the sampler no longer kept when they were asked for.
    """

    store: str | None = None
    pairs: int = 0
    last_seq: int = 0
    since_change: int = 0
    replayed: int = 0
    refused: int = 0
    gaps_recovered: int = 0
    changes: int = 0
    doubted: int = 0
    missed: int = 0


class LearningHeader(msgspec.Struct, kw_only=True):
    """The part of the state that is not arrays. What has a default belongs to an era.

    Attributes:
        fingerprint: of the nominal model and the tolerances it started from.
        claims: what is known of each model's errors.
        kept_of: how many pairs there were since the prior; the newest of them are kept.
        next_fit: pairs at which what is not known, or the tool after a change, is fitted again; None when nothing is.
        first_fit: whether that is the first one.
        answering: the model that answers.
        doubted_in_a_row: length of the present run of doubted pairs.
        replays_due: replay steps that are still owed.
        replay_position: how far they are: epochs begun, pairs of the present one, and how many of these were replayed.
        belief: what was believed of the chain before the first of these pairs, as bytes; None before the alignment.
        residual: what was known of the arm beyond that, as bytes; None if nothing was.
        orientation: what is known of how the marker is turned; None in a checkpoint of an older version.
        change: the last change; None where there was none.
        before: the state before it, for rollback; None where there is none. Its arrays' names begin with `BEFORE`.
    """

    fingerprint: str
    counters: Counters
    claims: ClaimsState
    curve: list[CurvePoint]
    curve_stride: int
    kept_of: int
    next_fit: int | None
    first_fit: bool
    answering: str = PRIOR
    doubted_in_a_row: int = 0
    replays_due: float = 0.0
    replay_position: tuple[int, int, int] = (0, 0, 0)
    belief: bytes | None = None
    residual: bytes | None = None
    orientation: OrientationState | None = None
    change: ChangeRecord | None = None
    before: LearningHeader | None = None


@dataclass(frozen=True)
class LearningState:
    """A learner's state.

    `arrays` are the nets by model, the kept pairs, those doubted in a row, what the claims need, and what a tool is
    fitted to.
    """

    header: LearningHeader
    arrays: Mapping[str, FloatArray]

    @property
    def before(self) -> LearningState | None:
        """The state before the last change; None where there is none."""
        if self.header.before is None:
            return None
        arrays = {name.removeprefix(BEFORE): each for name, each in self.arrays.items() if name.startswith(BEFORE)}
        return LearningState(self.header.before, arrays)

    def with_before(self, before: LearningState | None) -> LearningState:
        """The same state that can be rolled back to another one."""
        if before is None:
            return self
        header = msgspec.structs.replace(self.header, before=before.header)
        return LearningState(header, {**self.arrays, **{BEFORE + name: each for name, each in before.arrays.items()}})

    def poisoned(self) -> str | None:
        """Return the name of a net, or of what the pairs were, that cannot be; None when all is well."""
        nets = dict.fromkeys((name for name in self.arrays if name.startswith(NET)), np.inf)
        limits = {**nets, "q": LARGEST_Q, "x": FARTHEST_M}
        for name, limit in limits.items():
            if not (np.isfinite(self.arrays[name]).all() and (np.abs(self.arrays[name]) <= limit).all()):
                return name
        return None
