"""State machine of learning: takes pairs, runs one regime after another, and counts. Not thread-safe."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np

from bodyschema.interfaces.errors import RequestError
from bodyschema.interfaces.records import FARTHEST_M, LARGEST_Q, Pair
from bodyschema.learning.changes.record import ChangeRecord
from bodyschema.learning.config import LearnerConfig
from bodyschema.learning.nominal import NominalModel
from bodyschema.learning.regime import BoolArray, Regime
from bodyschema.learning.regimes import Regimes
from bodyschema.learning.state import Counters, Curve, LearningState

# Maximum number of pairs judged together, absolute and as a share of the known ones: early pairs matter more.
MOST_TOGETHER, TOGETHER = 25, 0.1
# As a share of a covariance's largest eigenvalue: rounding may push the smallest this far below zero.
ROUNDING = 1e-6


class LearnerCore:
    """Everything learnt so far.

    Args:
        nominal: the nominal model, where learning starts.
        settings: of the learner.
        together_s: maximum wait of pairs to be judged together [s].

    Attributes:
        regimes: the regimes and their models.
        counters: all counters; readers outside the learner's own calls must copy them.
        curve: the error [m] of the answering model on the last pairs, at some numbers of pairs.
        newest_utc: storage time of the last learnt pair, ISO 8601; None before any.
    """

    def __init__(self, nominal: NominalModel, settings: LearnerConfig, together_s: float) -> None:
        self._nominal, self._settings, self._together_s = nominal, settings, together_s
        self._task_numbers = itertools.count(1)
        self._before: LearningState | None = None
        self._met_at = 0.0
        self.counters, self.curve = Counters(), Curve()
        self.newest_utc: str | None = None
        self.regimes = self._at_nominal()

    @property
    def can_roll_back(self) -> bool:
        """True if the state before the last change is kept."""
        return self._before is not None

    @property
    def settled(self) -> bool:
        """True if all pairs so far have been judged."""
        return self.regimes.present is None or not self.regimes.present.met

    def learn(self, pair: Pair, now: float) -> None:
        """Learn one pair at once; if pairs are judged together, with the instant learner only.

        Raises:
            RequestError: it is not a pair of this robot and store, or not newer than the last one; nothing changed.
        """
        check_pair(pair, self.counters, self._nominal.joints)
        self.counters.store, self.counters.last_seq = pair.store, pair.seq
        self.counters.pairs += 1
        self.counters.since_change += 1
        self.newest_utc = pair.utc
        regime = self.regimes.present
        if regime is None:
            self.regimes.waiting.append(pair.q[None], pair.x[None], None if pair.R is None else pair.R[None])
        elif self._together_s == 0.0:
            self._judged(regime, [pair], np.array([not regime.learn(pair)]))
        else:
            if not regime.met:
                self._met_at = now
            regime.meet(pair)
            if len(regime.met) >= min(MOST_TOGETHER, max(int(TOGETHER * regime.memory.count), 1)) or self.judge_due(
                now
            ):
                self.judge()

    def judge_due(self, now: float) -> bool:
        """Return True if pairs have waited long enough to be judged."""
        return not self.settled and now - self._met_at >= self._together_s

    def judge(self) -> None:
        """Process all waiting pairs: compare the models, gate outliers, look for a change, and keep the pairs."""
        while (regime := self.regimes.present) is not None and regime.met:
            self._judged(regime, *regime.judge())
            if self.regimes.present is not None and self.regimes.present is not regime:
                for pair in regime.met:
                    self.regimes.present.meet(pair)

    def tool_changed(self) -> None:
        """Start with another tool: drop the pairs so far, and continue from the learnt model."""
        self.judge()
        if self.regimes.present is None:
            self.regimes = self._at_nominal()
        else:
            self._before = self._state_before(self.regimes.memory.count)
            self.regimes.change_tool(self.regimes.present)
        self.regimes.change = ChangeRecord.told(self.counters.last_seq)
        self.counters.changes += 1
        self.counters.since_change = 0

    def rollback(self) -> None:
        """Undo the last change, together with the pairs since then.

        Raises:
            RequestError: there was no change, or learning was reset since; nothing is changed.
        """
        if self._before is None:
            raise RequestError("there was no change since learning began, so there is no older model to go back to")
        since_change = self._before.header.counters.since_change
        regimes = Regimes.restored(self._before, self._nominal, self._settings, self._task_numbers)
        self.regimes, self._before, self.counters.since_change = regimes, self._before.before, since_change

    def reset_to_prior(self, *, forget_store: bool) -> None:
        """Forget the learnt model. With `forget_store`, pairs may come from another store, from its first one on."""
        if forget_store:
            self.counters = Counters(refused=self.counters.refused)
            self.curve, self.newest_utc = Curve(), None
        self.counters.since_change = 0
        self.regimes, self._before = self._at_nominal(), None

    def state(self) -> LearningState:
        """Return everything needed to resume."""
        self.judge()
        return self.regimes.state(self.counters, self.curve).with_before(self._before)

    def restore(self, state: LearningState) -> None:
        """Resume from a state.

        Raises:
            StateError: it belongs to another nominal model, or to other tolerances; nothing is changed.
        """
        regimes, header = Regimes.restored(state, self._nominal, self._settings, self._task_numbers), state.header
        self.regimes, self.counters, self._before = regimes, header.counters, state.before
        self.curve = Curve(header.curve, header.curve_stride)

    def _at_nominal(self) -> Regimes:
        return Regimes.at_nominal(self._nominal, self._settings, self._task_numbers)

    def _judged(self, regime: Regime, pairs: Sequence[Pair], doubted: BoolArray) -> None:
        """Count the pairs that `regime` has learnt or gated as outliers, and follow a change that they show."""
        error_m = regime.recent.means.get(regime.answering)
        first = self.counters.pairs - len(regime.met) - len(pairs) + 1
        if error_m is not None:
            for place in np.flatnonzero(~doubted).tolist():
                self.curve.add(first + place, error_m)
        self.counters.doubted += int(doubted.sum())
        if self._followed(regime, pairs[-1], learnt=not doubted[-1]):
            self.counters.changes += 1
            self.counters.since_change = self.regimes.memory.count + len(regime.met)

    def _followed(self, regime: Regime, pair: Pair, *, learnt: bool) -> bool:
        """Return True if the pairs up to this one show a change, and another regime has begun with it."""
        noticed = self.regimes.noticed(regime, pair)
        if noticed is None and (learnt or not regime.gate.perhaps_changed):
            return False
        since = 0 if noticed is None else sum(noticed.kept[noticed.first :])
        before = self._state_before(regime.memory.count - since)
        followed = noticed is not None and self.regimes.adapt(regime, noticed)
        if not (followed or (not learnt and self.regimes.follow_change(regime, pair))):
            return False
        self._before = before
        return True

    def _state_before(self, first: int) -> LearningState:
        """Return the state without the current regime's pairs from number `first` on."""
        state = self.regimes.state_before(first, self.counters, self.curve)
        state.header.counters.since_change -= 0 if self.regimes.present is None else len(self.regimes.present.met)
        return state


def check_pair(pair: Pair, counters: Counters, joints: int) -> None:
    """Raise RequestError if a pair is of another robot or store, not new, or not a measurement."""
    if counters.store not in (None, pair.store):
        raise RequestError(
            f"pair {pair.seq} comes from the store {pair.store}, this learner learnt from {counters.store}"
        )
    if pair.seq <= counters.last_seq:
        raise RequestError(f"pair {pair.seq} has been learnt already; the last one was {counters.last_seq}")
    if len(pair.q) != joints:
        raise RequestError(f"pair {pair.seq} has {len(pair.q)} joint angles, this robot has {joints}")
    if not all(np.isfinite(part).all() for part in (pair.q, pair.x, pair.cov)):
        raise RequestError(f"pair {pair.seq} has a number that is not finite")
    if np.abs(pair.x).max() > FARTHEST_M:
        raise RequestError(f"pair {pair.seq} lies {np.abs(pair.x).max():.0f} m away; positions are in metres")
    if np.abs(pair.q).max() > LARGEST_Q:
        raise RequestError(f"pair {pair.seq} has the joint angle {np.abs(pair.q).max():.3g}; angles are in radians")
    if np.abs(pair.cov).max() > FARTHEST_M**2:
        raise RequestError(f"pair {pair.seq} says that it may be {np.sqrt(np.abs(pair.cov).max()):.3g} m wrong")
    spread = np.linalg.eigvalsh(pair.cov)
    if spread[0] < -ROUNDING * max(spread[-1], 0.0):
        raise RequestError(f"pair {pair.seq} has a cov that is no covariance: a variance of {spread[0]:.3g} m²")
