"""Online learner: pairs in, models side by side, a snapshot that answers.

Two threads may use one object: one calls `learn`, the other `work`, and each holds the lock for short pieces only.
Query threads take `snapshot`, which needs no lock.
"""

from __future__ import annotations

import copy
import threading

import numpy as np

from bodyschema.daemon.config import LearnerConfig
from bodyschema.daemon.transport.status import CurvePoint, OrientationStatus
from bodyschema.interfaces.records import FloatArray, Pair
from kbmaps import ChainBelief, Recent

from .change import ChangeRecord
from .course import Course
from .era import LOOKED_BACK, Era
from .members import PRIOR, SOLVED
from .nominal import NominalModel, chain_tolerances
from .outlook import Known
from .snapshot import Snapshot
from .solver import Solver
from .solving import Solving
from .state import Counters, LearningState

# Number of predicted pairs before a model's errors give an expected error.
FEWEST_TO_CLAIM = 5.0
FEED_PAIRS = 256
REGION_RAD = np.radians(3.0)
REGION_SAMPLES = 256


class Learning:
    """Learns the forward kinematics of one robot from pairs.

    The models are in its `Eras`. This class counts, synchronises the two threads, and publishes.
    """

    def __init__(
        self, nominal: NominalModel, settings: LearnerConfig, solver: Solver, *, together_s: float = 0.0
    ) -> None:
        """Initialise before any pair.

        Args:
            nominal: the nominal model, where learning starts.
            settings: of the learner.
            solver: of the models that need all pairs.
            together_s: maximum wait of pairs to be judged together [s], which costs a fraction of judging each. The
                instant learner does not wait.
        """
        self._nominal, self._settings = nominal, settings
        self._solving = Solving(solver, settings.solve_every)
        self._lock = threading.Lock()
        self._course = Course(nominal, settings, together_s)
        self._publish()

    @property
    def snapshot(self) -> Snapshot:
        """Snapshot of the answering model."""
        return self._snapshot

    @property
    def belief(self) -> ChainBelief | None:
        """Posterior of the chain from the pairs with the current tool; None before the first solution."""
        return self._course.eras.claims.belief

    @property
    def nominal(self) -> NominalModel:
        """Nominal model, where learning starts."""
        return self._nominal

    @property
    def aligning(self) -> bool:
        """True while the frame is not known."""
        return self._course.eras.present is None

    @property
    def at_rest(self) -> bool:
        """True if no work is left with the pairs so far: nothing to fit, to solve or to replay.

        For the thread that calls `work`.
        """
        with self._lock:
            era, count = self._course.eras.present, self._course.eras.memory.count
            if self._course.eras.fitting.due(count) or self._course.eras.looking or not self._course.settled:
                return False
            return era is None or (not era.owes_replays and self._solving.has_solved(era.task_number, count))

    @property
    def counters(self) -> Counters:
        """Copy of all counters."""
        with self._lock:
            return copy.copy(self._course.counters)

    @property
    def curve(self) -> list[CurvePoint]:
        """Error [m] of the answering model on the last pairs, at some numbers of pairs."""
        with self._lock:
            return self._course.curve.points

    @property
    def change(self) -> ChangeRecord | None:
        """Last change, reported or detected; None: there was none, or it was rolled back."""
        with self._lock:
            return self._course.eras.change

    @property
    def can_roll_back(self) -> bool:
        """True if the state before the last change is kept."""
        return self._course.can_roll_back

    def recent(self) -> Recent:
        """Return the models' errors on the last pairs, each predicted before it was learnt."""
        with self._lock:
            era = self._course.eras.present
            return Recent(0, {}) if era is None else era.recent

    def claimed_error_m(self) -> float | None:
        """Return the expected mean distance to the truth [m] in the data's region; None while there are too few pairs.

        The region: within a few degrees (`REGION_RAD` per joint) of the kept pairs.
        """
        with self._lock:
            era, snapshot = self._course.eras.present, self._snapshot
            answering = None if era is None else self._course.eras.claims.errors.get(era.answering)
            if era is None or answering is None or answering.weight < FEWEST_TO_CLAIM:
                return None
            region = self._region(era)
        return snapshot.expected_error_m(region)

    def _region(self, era: Era) -> FloatArray:
        """Return poses (n, d) [rad, m] that represent the data's region; the same for the same pairs."""
        rng = np.random.default_rng(0)
        q, _ = era.memory.at(rng.integers(len(era.memory), size=REGION_SAMPLES))
        return q + rng.normal(0.0, 1.0, q.shape) * self._nominal.reach(REGION_RAD)

    def orientation_status(self) -> OrientationStatus | None:
        """Return the accuracy of the marker's orientation; None if no pair with the current tool has one."""
        with self._lock:
            era, model = self._course.eras.present, self._snapshot.orientation
            if era is None or model is None:
                return None
            pairs, errors, region = era.orientations.pairs, era.orientations.prequential_rad(), self._region(era)
        claimed = model.expected_error(region) if pairs >= FEWEST_TO_CLAIM else None
        return OrientationStatus(pairs, model.name, errors, claimed)

    def known(self) -> Known | None:
        """Return the evidence for a data outlook; None before the first solution with the current tool.

        For the thread that calls `work`.
        """
        with self._lock:
            era, claims = self._course.eras.present, self._course.eras.claims
            if era is None or claims.belief is None or not self._solving.works_on(era.task_number):
                return None
            seen, _ = era.memory.some(era.memory.count, LOOKED_BACK)
            q, x, _ = era.memory.since(self._solving.fed - LOOKED_BACK, LOOKED_BACK)  # pairs that the solver knows
            return Known(
                nominal=self._nominal,
                belief=claims.belief,
                wide=claims.wide or claims.belief,
                tolerances=chain_tolerances(self._settings),
                claim=claims.of(era.answering, era.model.predict),
                solved=era.answering in SOLVED,
                pairs=self._course.counters.since_change,
                region=self._region(era),
                seen=seen,
                q=q,
                x=x,
            )

    def kept(self, limit: int) -> tuple[FloatArray, FloatArray]:
        """Return at most `limit` of the kept pairs, evenly spread: q (n, d) [rad, m], x (n, 3) [m].

        Only pairs with the current tool.
        """
        with self._lock:
            memory = self._course.eras.memory
            places = np.unique(np.linspace(0, len(memory) - 1, min(limit, len(memory))).astype(np.intp))
            return memory.at(places)

    def learn(self, pair: Pair, now: float) -> None:
        """Learn one pair at once.

        Raises:
            RequestError: it is not a pair of this robot and store, or not newer than the last one; nothing changed.
        """
        with self._lock:
            self._course.learn(pair, now)
            self._publish()

    def judge_due(self, now: float) -> None:
        """Judge the pairs that have waited long enough."""
        with self._lock:
            if self._course.judge_due(now):
                self._course.judge()
                self._publish()

    def refuse(self) -> None:
        """Count a pair that could not be accepted."""
        with self._lock:
            self._course.counters.refused += 1

    def recovered(self, pairs: int) -> None:
        """Count pairs that had to be fetched from history."""
        with self._lock:
            self._course.counters.gaps_recovered += pairs

    def missed(self, pairs: int) -> None:
        """Count pairs that are lost."""
        with self._lock:
            self._course.counters.missed += pairs

    def tool_changed(self) -> None:
        """Start with another tool: drop the pairs so far, and continue from the learnt model."""
        with self._lock:
            self._course.tool_changed()
            self._publish()

    def rollback(self) -> None:
        """Undo the last change, together with the pairs since then.

        Raises:
            RequestError: there was no change, or learning was reset since; nothing is changed.
        """
        with self._lock:
            self._course.rollback()
            self._publish()

    def reset_to_prior(self, *, forget_store: bool = False) -> None:
        """Forget the learnt model. With `forget_store`, pairs may come from another store, from its first one on."""
        with self._lock:
            self._course.reset_to_prior(forget_store=forget_store)
            self._publish()

    def restart_solver(self) -> None:
        """Give a solver that has lost its pairs all of them again. For the thread that calls `work`."""
        self._solving.restart()
        with self._lock:
            if self._course.eras.present is not None:
                self._course.eras.present.solve_from_what_is_known()

    def solve_soon(self) -> None:
        """Let the solver catch up even with fewer than `solve_every` new pairs. For the same thread."""
        self._solving.solve_soon()

    def work(self) -> bool:
        """Do one small piece of background work; return False if there is none."""
        return self._fit() or self._look_again() or self._serve_solver() or self._replay()

    def state(self) -> LearningState:
        """Return everything needed to resume."""
        with self._lock:
            return self._course.state()

    def restore(self, state: LearningState) -> None:
        """Resume from a state; the solver gets the kept pairs again in the background.

        Raises:
            StateError: it belongs to another nominal model, or to other tolerances.
        """
        with self._lock:
            self._course.restore(state)
            self._publish()

    def _look_again(self) -> bool:
        """Identify the last change again, with more pairs."""
        with self._lock:
            if not self._course.eras.looking:
                return False
            self._course.judge()
            if self._course.eras.look_again():
                self._course.counters.since_change = self._course.eras.memory.count
                self._publish()
        return True

    def _fit(self) -> bool:
        """Fit an unknown frame or a changed tool, when it is due."""
        with self._lock:
            memory = self._course.eras.memory
            if not self._course.eras.fitting.due(memory.count):
                return False
            count, fitting = memory.count, copy.copy(self._course.eras.fitting)
            q, x = memory.all()
        fit = fitting.fit(q, x)
        with self._lock:
            self._course.judge()
            if memory is self._course.eras.memory:  # else another regime has begun
                self._course.counters.doubted += self._course.eras.fitted(fit, count)
                self._publish()
        return True

    def _serve_solver(self) -> bool:
        """Give the solver its pairs, request solutions from time to time, take its results."""
        solving = self._solving
        with self._lock:
            if self._course.eras.present is None:
                return False
            task = self._course.eras.present.task
        if solving.busy:
            return self._take_solution()
        if solving.begin(task):
            return True
        with self._lock:
            era = self._course.eras.present
            if era is None or era.task_number != task.number:
                return True
            asking = solving.due and solving.fed == era.memory.count
            if asking:
                self._course.judge()  # the solver shall know everything that the instant learner knows
                if self._course.eras.present is not era:
                    return True
                era.ask()
            q, x, fed = era.memory.since(solving.fed, FEED_PAIRS)
            turns = era.memory.turns_since(solving.fed, FEED_PAIRS)
        if len(q):
            solving.feed(q, x, fed, turns if np.isfinite(turns).any() else None)
        if asking:
            solving.ask()
        return asking or len(q) > 0

    def _take_solution(self) -> bool:
        solved = self._solving.poll()
        if solved is None:
            return False
        with self._lock:
            era = self._course.eras.present
            if era is None or solved.task != era.task_number:
                return True
            if solved.model is not None:
                era.take(solved, solved.model, self._solving.fed)
            if solved.orientation is not None:
                era.take_orientation(solved.orientation)
            self._publish()
        return True

    def _replay(self) -> bool:
        with self._lock:
            replayed = 0 if self._course.eras.present is None else self._course.eras.present.replay()
            if replayed:
                self._course.counters.replayed += replayed
                self._publish()
        return replayed > 0

    def _publish(self) -> None:
        era, claims = self._course.eras.present, self._course.eras.claims
        answering = PRIOR if era is None else era.answering
        self._snapshot = Snapshot(
            answering=answering,
            model=None if era is None else era.model,
            map=None if era is None else era.map,
            claim=claims.of(answering, None if era is None else era.model.predict),
            support=claims.support,
            pairs=self._course.counters.pairs,
            newest_utc=self._course.newest_utc,
            waiting_for=self._waiting_for() if era is None else "",
            orientation=None if era is None else era.orientation,
        )

    def _waiting_for(self) -> str:
        needed, have = self._nominal.pairs_to_align, self._course.eras.waiting.count
        return (
            f"there is no model yet: robot.toml says {self._nominal.unknown}, so positions have no frame until about "
            f"{needed} pairs have come ({have} so far). Start the sampler with `bodyschema sampler` and guide the arm"
        )
