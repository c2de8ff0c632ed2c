"""Online learner: pairs in, models side by side, a snapshot that answers.

Two threads may use one object: one calls `learn`, the other `work`, and each holds the lock for short pieces only.
Query threads take `snapshot`, which needs no lock.
"""

from __future__ import annotations

import copy
import itertools
import threading
from collections.abc import Callable, Sequence

import numpy as np

from bodyschema.interfaces.errors import RequestError
from bodyschema.interfaces.records import FloatArray, Pair, PairLimits
from bodyschema.learning.config import LearnerConfig
from bodyschema.learning.data_outlook import LearnerEvidence
from bodyschema.learning.model_bank import PRIOR, SOLVED
from bodyschema.learning.nominal import NominalModel, chain_tolerances
from bodyschema.learning.regime import BoolArray, Regime, RegimeSettings
from bodyschema.learning.regime_history import Regimes
from bodyschema.learning.snapshot import Snapshot
from bodyschema.learning.solvers.solver import Solver, SolverClient
from bodyschema.learning.state import Counters, Curve, LearningState
from bodyschema.learning.status import ChangeRecord, CurvePoint, OrientationStatus
from bodyschema.learning.uncertainty import UncertaintySettings
from kbmaps import ChainBelief, Recent


class OnlineSettings:
    # Maximum number of pairs judged together, absolute and as a share of the known ones: early pairs matter more.
    max_together, together_share = 25, 0.1
    # As a share of a covariance's largest eigenvalue: rounding may push the smallest this far below zero.
    rounding_share = 1e-6
    feed_pairs = 256
    region_rad = np.radians(3.0)
    region_samples = 256


class OnlineLearner:
    """Online learner of the forward kinematics of one robot from pairs.

    It runs one regime after another, whose models are in `Regimes`; it counts, synchronises the two threads, and
    publishes.

    Attributes:
        nominal: nominal model, from which learning starts.
    """

    def __init__(
        self,
        nominal: NominalModel,  # the nominal model, from which learning starts
        settings: LearnerConfig,
        solver: Solver,  # solver of the models that need all pairs
        *,
        # maximum wait of pairs to be evaluated together [s], at a fraction of the cost of single ones. The instant
        # learner does not wait.
        batch_wait_s: float = 0.0,
        common: Callable[[FloatArray], FloatArray] | None = None,  # as in `Snapshot`
    ) -> None:
        self.nominal, self._settings, self._common = nominal, settings, common
        self._solving = SolverClient(solver, settings.solve_every)
        self._lock = threading.Lock()
        self._batch_wait_s = batch_wait_s
        self._task_numbers = itertools.count(1)
        self._before: LearningState | None = None
        self._pending_since = 0.0
        self._counters, self._curve = Counters(), Curve()
        self._newest_utc: str | None = None
        self._regimes = self._initial_regimes()
        self._publish()

    @property
    def snapshot(self) -> Snapshot:
        return self._snapshot

    @property
    def belief(self) -> ChainBelief | None:
        """Posterior of the chain from the pairs with the current tool; None before the first solution."""
        return self._regimes.uncertainty.belief

    @property
    def aligning(self) -> bool:
        """True while the frame is not known."""
        return self._regimes.current is None

    @property
    def at_rest(self) -> bool:
        """True if no work is left with the pairs so far: nothing to fit, to solve or to replay.

        For the thread that calls `work`.
        """
        with self._lock:
            regime, count = self._regimes.current, self._regimes.memory.count
            if self._regimes.fitting.due(count) or self._regimes.review_due or not self._nothing_pending:
                return False
            return regime is None or (
                not regime.has_due_replays and self._solving.has_solved(regime.task_number, count)
            )

    @property
    def counters(self) -> Counters:
        with self._lock:
            return copy.copy(self._counters)

    @property
    def curve(self) -> list[CurvePoint]:
        """Error [m] of the answering model on the last pairs, after increasing numbers of pairs."""
        with self._lock:
            return self._curve.points

    @property
    def change(self) -> ChangeRecord | None:
        """Last change, reported or detected; None if there was none, or it was rolled back."""
        with self._lock:
            return self._regimes.change

    @property
    def can_roll_back(self) -> bool:
        """True if the state before the last change is kept."""
        return self._before is not None

    def recent(self) -> Recent:
        """Return the models' errors on the last pairs, each predicted before it was learnt."""
        with self._lock:
            regime = self._regimes.current
            return Recent(0, {}) if regime is None else regime.recent

    def claimed_error_m(self) -> float | None:
        """Return the expected mean distance [m] in the data's region to noise-free camera measurements.

        None if there are too few pairs. The region is within a few degrees (`region_rad` per joint) of the kept pairs.
        """
        with self._lock:
            regime, snapshot = self._regimes.current, self._snapshot
            answering = None if regime is None else self._regimes.uncertainty.errors.get(regime.answering)
            if (
                regime is None or answering is None or answering.weight < UncertaintySettings.warm_pairs / 2
            ):  # the prior expectation counts more than the errors
                return None
            region = self._region(regime)
        return snapshot.expected_error_m(region)

    def common_error_m(self) -> float | None:
        """Return the expected mean error [m] in the data's region that all pairs share; None if it is unknown."""
        with self._lock:
            regime, snapshot = self._regimes.current, self._snapshot
            if regime is None or len(regime.memory) == 0:
                return None
            region = self._region(regime)
        return snapshot.common_error_m(region)

    def _region(self, regime: Regime) -> FloatArray:
        """Return poses (n, d) [rad, m] that represent the data's region; the same for the same pairs."""
        rng = np.random.default_rng(0)
        q, _ = regime.memory.at(rng.integers(len(regime.memory), size=OnlineSettings.region_samples))
        return q + rng.normal(0.0, 1.0, q.shape) * self.nominal.reach(OnlineSettings.region_rad)

    def orientation_status(self) -> OrientationStatus | None:
        """Return the accuracy of the marker's orientation; None if no pair with the current tool has one."""
        with self._lock:
            regime, model = self._regimes.current, self._snapshot.orientation
            if regime is None or model is None:
                return None
            known, region = regime.orientations, self._region(regime)
            pairs, errors = known.pairs, known.prequential_rad()
        claimed = model.expected_error(region) if pairs >= UncertaintySettings.warm_pairs / 2 else None
        return OrientationStatus(pairs, model.name, errors, claimed)

    def known(self) -> LearnerEvidence | None:
        """Return the evidence for a data outlook; None before the first solution with the current tool.

        For the thread that calls `work`.
        """
        with self._lock:
            regime, uncertainty = self._regimes.current, self._regimes.uncertainty
            if regime is None or uncertainty.belief is None or not self._solving.works_on(regime.task_number):
                return None
            seen, *_ = regime.memory.spread_before(regime.memory.count, RegimeSettings.looked_back)
            known = self._solving.fed  # number of pairs that the solver knows
            q, x, _ = regime.memory.since(known - RegimeSettings.looked_back, RegimeSettings.looked_back)
            return LearnerEvidence(
                nominal=self.nominal,
                belief=uncertainty.belief,
                wide=uncertainty.wide or uncertainty.belief,
                tolerances=chain_tolerances(self._settings),
                uncertainty=uncertainty.of(regime.answering, regime.model.predict),
                solved=regime.answering in SOLVED,
                pairs=self._counters.since_change,
                region=self._region(regime),
                seen=seen,
                q=q,
                x=x,
            )

    def kept(self, limit: int) -> tuple[FloatArray, FloatArray]:
        """Return at most `limit` of the kept pairs, evenly spread: q (n, d) [rad, m], x (n, 3) [m].

        Only pairs with the current tool.
        """
        with self._lock:
            memory = self._regimes.memory
            places = np.unique(np.linspace(0, len(memory) - 1, min(limit, len(memory))).astype(np.intp))
            return memory.at(places)

    def learn(self, pair: Pair, now: float) -> None:
        """Learn one pair at once.

        Raises:
            RequestError: it is not a pair of this robot and store, or not newer than the last one; nothing changed.
        """
        with self._lock:
            _check_pair(pair, self._counters, self.nominal.joints)
            self._counters.store, self._counters.last_seq = pair.store, pair.seq
            self._counters.pairs += 1
            self._counters.since_change += 1
            self._newest_utc = pair.utc
            regime = self._regimes.current
            if regime is None:
                turn = None if pair.R is None else pair.R[None]
                self._regimes.waiting.append(pair.q[None], pair.x[None], pair.cov[None], turn)
            elif self._batch_wait_s == 0.0:
                self._record_learnt(regime, [pair], np.array([not regime.learn(pair)]))
            else:
                if not regime.pending:
                    self._pending_since = now
                regime.learn_instantly(pair)
                enough = max(int(OnlineSettings.together_share * regime.memory.count), 1)
                enough = min(OnlineSettings.max_together, enough)
                if len(regime.pending) >= enough or self._is_learning_due(now):
                    self._learn_pending()
            self._publish()

    def learn_due(self, now: float) -> None:
        """Process the pairs that have waited long enough."""
        with self._lock:
            if self._is_learning_due(now):
                self._learn_pending()
                self._publish()

    def refuse(self) -> None:
        with self._lock:
            self._counters.refused += 1

    def recovered(self, pairs: int) -> None:
        """Count pairs that had to be fetched from history."""
        with self._lock:
            self._counters.gaps_recovered += pairs

    def missed(self, pairs: int) -> None:
        with self._lock:
            self._counters.missed += pairs

    def tool_changed(self) -> None:
        """Start with another tool: drop the pairs so far, and continue from the learnt model."""
        with self._lock:
            self._learn_pending()
            if self._regimes.current is None:
                self._regimes = self._initial_regimes()
            else:
                self._before = self._state_before(self._regimes.memory.count)
                self._regimes.change_tool(self._regimes.current)
            self._regimes.change = ChangeRecord.reported(self._counters.last_seq)
            self._counters.changes += 1
            self._counters.since_change = 0
            self._publish()

    def rollback(self) -> None:
        """Undo the last change, together with the pairs since then.

        Raises:
            RequestError: there was no change, or learning was reset since; nothing is changed.
        """
        with self._lock:
            if self._before is None:
                raise RequestError("there was no change since learning began, so there is no older model to go back to")
            since_change = self._before.header.counters.since_change
            regimes = Regimes.restored(self._before, self.nominal, self._settings, self._task_numbers)
            self._regimes, self._before, self._counters.since_change = regimes, self._before.before, since_change
            self._publish()

    def reset_to_prior(self, *, forget_store: bool = False) -> None:
        """Forget the learnt model. With `forget_store`, pairs may come from another store, from its first one on."""
        with self._lock:
            if forget_store:
                self._counters = Counters(refused=self._counters.refused)
                self._curve, self._newest_utc = Curve(), None
            self._counters.since_change = 0
            self._regimes, self._before = self._initial_regimes(), None
            self._publish()

    def restart_solver(self) -> None:
        """Send all pairs again to a solver that has lost them. For the thread that calls `work`."""
        self._solving.restart()
        with self._lock:
            if self._regimes.current is not None:
                self._regimes.current.continue_from_last_solutions()

    def solve_soon(self) -> None:
        """Start the solver even with fewer than `solve_every` new pairs. For the same thread."""
        self._solving.solve_soon()

    def work(self) -> bool:
        """Do one small piece of background work; return False if nothing was left to do."""
        return self._fit() or self._review_change() or self._serve_solver() or self._replay()

    def state(self) -> LearningState:
        """Return everything needed to resume."""
        with self._lock:
            self._learn_pending()
            return self._regimes.state(self._counters, self._curve).with_before(self._before)

    def restore(self, state: LearningState) -> None:
        """Resume from a state; the solver gets the kept pairs again in the background.

        Raises:
            StateError: it belongs to another nominal model, or to other tolerances.
        """
        with self._lock:
            regimes, header = Regimes.restored(state, self.nominal, self._settings, self._task_numbers), state.header
            self._regimes, self._counters, self._before = regimes, header.counters, state.before
            self._curve = Curve(header.curve, header.curve_stride)
            self._publish()

    @property
    def _nothing_pending(self) -> bool:
        """True if all pairs so far have been evaluated."""
        return self._regimes.current is None or not self._regimes.current.pending

    def _is_learning_due(self, now: float) -> bool:
        """Return True if pairs have waited long enough to be evaluated."""
        return not self._nothing_pending and now - self._pending_since >= self._batch_wait_s

    def _learn_pending(self) -> None:
        """Evaluate all waiting pairs: compare the models, gate outliers, look for a change, and keep the pairs."""
        while (regime := self._regimes.current) is not None and regime.pending:
            self._record_learnt(regime, *regime.learn_pending())
            if self._regimes.current is not None and self._regimes.current is not regime:
                for pair in regime.pending:
                    self._regimes.current.learn_instantly(pair)

    def _record_learnt(self, regime: Regime, pairs: Sequence[Pair], doubted: BoolArray) -> None:
        """Count the pairs that `regime` has learnt or gated as outliers, and follow a change detected in them."""
        error_m = regime.recent.means.get(regime.answering)
        first = self._counters.pairs - len(regime.pending) - len(pairs) + 1
        if error_m is not None:
            for place in np.flatnonzero(~doubted).tolist():
                self._curve.add(first + place, error_m)
        self._counters.doubted += int(doubted.sum())
        if self._follow_change(regime, pairs[-1], learnt=not doubted[-1]):
            self._counters.changes += 1
            self._counters.since_change = self._regimes.memory.count + len(regime.pending)

    def _follow_change(self, regime: Regime, pair: Pair, *, learnt: bool) -> bool:
        """Return True if the pairs up to this one reveal a change, so that another regime has begun with it."""
        detected = self._regimes.detected(regime, pair)
        if detected is None and (learnt or not regime.gate.possibly_changed):
            return False
        since = 0 if detected is None else sum(detected.kept[detected.first :])
        before = self._state_before(regime.memory.count - since)
        adapted = detected is not None and self._regimes.adapt(regime, detected)
        if not (adapted or (not learnt and self._regimes.follow_tool_change(regime, pair))):
            return False
        self._before = before
        return True

    def _state_before(self, first: int) -> LearningState:
        """Return the state without the current regime's pairs from number `first` on."""
        state = self._regimes.state_before(first, self._counters, self._curve)
        state.header.counters.since_change -= 0 if self._regimes.current is None else len(self._regimes.current.pending)
        return state

    def _initial_regimes(self) -> Regimes:
        return Regimes.initial(self.nominal, self._settings, self._task_numbers)

    def _review_change(self) -> bool:
        """Identify the last change again, with more pairs."""
        with self._lock:
            if not self._regimes.review_due:
                return False
            self._learn_pending()
            if self._regimes.review_change():
                self._counters.since_change = self._regimes.memory.count
                self._publish()
        return True

    def _fit(self) -> bool:
        """Fit an unknown frame or a changed tool, if it is due."""
        with self._lock:
            memory = self._regimes.memory
            if not self._regimes.fitting.due(memory.count):
                return False
            count, fitting = memory.count, copy.copy(self._regimes.fitting)
            (q, x), cov = memory.all(), memory.cov_since(0)
        fit = fitting.fit(q, x, cov)
        with self._lock:
            self._learn_pending()
            if memory is self._regimes.memory:  # otherwise another regime has begun
                self._counters.doubted += self._regimes.fitted(fit, count)
                self._publish()
        return True

    def _serve_solver(self) -> bool:
        """Send the solver its pairs, request solutions at intervals, and take its results."""
        solving = self._solving
        with self._lock:
            if self._regimes.current is None:
                return False
            task = self._regimes.current.task
        if solving.busy:
            return self._take_solution()
        if solving.begin(task):
            return True
        with self._lock:
            regime = self._regimes.current
            if regime is None or regime.task_number != task.number:
                return True
            asking = solving.due and solving.fed == regime.memory.count
            if asking:
                self._learn_pending()  # the solver must know everything that the instant learner knows
                if self._regimes.current is not regime:
                    return True
                regime.request_solution()
            q, x, fed = regime.memory.since(solving.fed, OnlineSettings.feed_pairs)
            both = regime.memory.cov_since, regime.memory.turns_since
            cov, turns = (each(solving.fed, OnlineSettings.feed_pairs) for each in both)
        if len(q):
            solving.feed(q, x, fed, cov, turns if np.isfinite(turns).any() else None)
        if asking:
            solving.request_solution()
        return asking or len(q) > 0

    def _take_solution(self) -> bool:
        solved = self._solving.poll()
        if solved is None:
            return False
        with self._lock:
            regime = self._regimes.current
            if regime is None or solved.task != regime.task_number:
                return True
            if solved.model is not None:
                regime.take(solved, solved.model, self._solving.fed)
            if solved.orientation is not None:
                regime.orientations.take(solved.orientation)
            self._publish()
        return True

    def _replay(self) -> bool:
        with self._lock:
            replayed = 0 if self._regimes.current is None else self._regimes.current.replay()
            if replayed:
                self._counters.replayed += replayed
                self._publish()
        return replayed > 0

    def _publish(self) -> None:
        regime, uncertainty = self._regimes.current, self._regimes.uncertainty
        answering = PRIOR if regime is None else regime.answering
        self._snapshot = Snapshot(
            answering=answering,
            model=None if regime is None else regime.model,
            map=None if regime is None else regime.map,
            uncertainty=uncertainty.of(answering, None if regime is None else regime.model.predict),
            support=uncertainty.support,
            pairs=self._counters.pairs,
            newest_utc=self._newest_utc,
            waiting_for=self._waiting_for() if regime is None else "",
            orientation=None if regime is None else regime.orientation,
            common=self._common,
        )

    def _waiting_for(self) -> str:
        needed, have = self.nominal.pairs_to_align, self._regimes.waiting.count
        if have >= needed:
            return (
                f"there is no model yet: robot.toml says {self.nominal.unknown}, and the first fit of the {have} "
                "samples so far is not finished. Ask again in some seconds; if it stays so, guide the arm to other "
                "poses"
            )
        return (
            f"there is no model yet: robot.toml says {self.nominal.unknown}, so positions have no frame until about "
            f"{needed} samples have come ({have} so far). Start the sampler with `bodyschema run sampler` and guide "
            "the arm"
        )


def _check_pair(pair: Pair, counters: Counters, joints: int) -> None:
    """Raise RequestError if a pair is of another robot or store, not new, or not a measurement."""
    if counters.store not in (None, pair.store):
        raise RequestError(
            f"sample {pair.seq} comes from the store {pair.store}, this learner learnt from {counters.store}"
        )
    if pair.seq <= counters.last_seq:
        raise RequestError(f"sample {pair.seq} has been learnt already; the last one was {counters.last_seq}")
    if len(pair.q) != joints:
        raise RequestError(f"sample {pair.seq} has {len(pair.q)} joint angles, this robot has {joints}")
    if not all(np.isfinite(part).all() for part in (pair.q, pair.x, pair.cov)):
        raise RequestError(f"sample {pair.seq} has a number that is not finite")
    if np.abs(pair.x).max() > PairLimits.farthest_m:
        raise RequestError(f"sample {pair.seq} lies {np.abs(pair.x).max():.0f} m away; positions are in metres")
    if np.abs(pair.q).max() > PairLimits.largest_q:
        raise RequestError(f"sample {pair.seq} has the joint angle {np.abs(pair.q).max():.3g}; angles are in radians")
    if np.abs(pair.cov).max() > PairLimits.farthest_m**2:
        raise RequestError(f"sample {pair.seq} says that it may be {np.sqrt(np.abs(pair.cov).max()):.3g} m wrong")
    spread = np.linalg.eigvalsh(pair.cov)
    if spread[0] < -OnlineSettings.rounding_share * max(spread[-1], 0.0):
        raise RequestError(f"sample {pair.seq} has a cov that is no covariance: a variance of {spread[0]:.3g} m²")
