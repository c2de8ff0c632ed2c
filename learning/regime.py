"""Regime: the models learnt with one tool on top of one prior."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from bodyschema.interfaces.records import FloatArray, Pair
from bodyschema.learning.changes.known_arm import KnownArm
from bodyschema.learning.changes.monitor import ChangeMonitor, MonitorSettings, Reference
from bodyschema.learning.changes.outlier_gate import OutlierGate, OutlierSettings, inlier_mask, limits_m
from bodyschema.learning.config import LearnerConfig
from bodyschema.learning.model_bank import EXACT, INSTANT, PRIOR, RESIDUAL, RIGID, LearntModel, ModelBank
from bodyschema.learning.orientation import OrientationModel, Orientations, OrientationSettings
from bodyschema.learning.replay_memory import PairMemory, Permutations
from bodyschema.learning.solvers.solver import Solved, Task
from bodyschema.learning.state import NET_PREFIX, LearningHeader
from bodyschema.learning.uncertainty import UncertaintyTracker
from bodyschema.learning.variance_terms import QueryPoints
from kbmaps import ChainBelief, KBMap, Recent, follow_a_path


class RegimeSettings:
    # Number of pairs that determine the errors of a refitted prior, and that are replayed on top of it.
    recent: int = 200
    replay_steps: int = 64
    max_late_pairs: int = 100  # maximum number of pairs received during a solve that judge its solution
    # With this share of new pairs, the last solution no longer applies: the new one is judged by these pairs alone.
    restart_share: float = 0.25
    replay_errors: int = 4
    looked_back: int = 500  # number of learnt pairs on which a model's fit is assessed


NO_TURN = (math.nan,) * 4

BoolArray = NDArray[np.bool_]


class Regime:
    """Learner of the models of one tool side by side, which chooses the one that answers.

    It has no lock of its own. The results of earlier regimes come as `prior`, `arm` and `uncertainty`.
    """

    def __init__(
        self,
        prior: KBMap,  # the map on top of which to learn
        arm: KnownArm,  # prior of the arm before the first pair
        uncertainty: UncertaintyTracker,  # uncertainties of the models; updated here during the regime
        settings: LearnerConfig,
        task_numbers: Iterator[int],  # numbers for the solver's tasks that no other regime has
    ) -> None:
        self.models = ModelBank(prior)
        self.memory = PairMemory(prior.joints, settings.replay_capacity)  # the pairs with this tool
        self.gate = OutlierGate(prior.joints)
        self.orientations = Orientations(arm.chain.chain)  # models of the marker's orientation, if pairs have one
        self.monitor = ChangeMonitor()
        self.arm = arm  # or with the last solutions if these stand for pairs that are no longer kept
        self.answering = self._answering_map = PRIOR  # the model that answers
        self._uncertainty, self._replays_per_pair = uncertainty, settings.replays_per_pair
        uncertainty.set_prior(arm.chain)
        self._pending: list[tuple[Pair, FloatArray]] = []
        self._limit_m = math.inf
        self._order = Permutations(0)
        self._replays_due = 0.0
        self._solver_prior: KBMap | None = None
        self._task_numbers = task_numbers
        self.task_number = next(task_numbers)  # number of the solver's current task

    @property
    def model(self) -> LearntModel:
        return self.models.model(self.answering)

    @property
    def map(self) -> KBMap:
        """Answering model if it is a KB-Map, otherwise the best KB-Map."""
        return self.models.map(self._answering_map)

    @property
    def task(self) -> Task:
        solver_prior = self._solver_prior
        prior = solver_prior or self.models.prior
        return Task(
            self.task_number,
            prior,
            self.arm.chain,
            self.arm.residual,
            prior_stays=solver_prior is not None,
            tolerances=self.arm.tolerances,
        )

    @property
    def has_due_replays(self) -> bool:
        """True if replay steps are due."""
        return self._replays_due >= 1.0 and len(self.memory) > 0

    @property
    def pending(self) -> Sequence[Pair]:
        """Pairs that the instant learner has learnt and that are not evaluated yet."""
        return [pair for pair, _ in self._pending]

    def limit_m(self, pair: Pair) -> float:
        """Return the distance from its prediction beyond which the pair is an outlier [m]."""
        point = QueryPoints(pair.q[None])
        predicted = self.models.predict(self.answering, point.q)
        return float(self._limits_m(point, predicted, np.diag(pair.cov)[None])[0])

    def learn(self, pair: Pair) -> bool:
        """Learn one pair and evaluate it; return False if it is an outlier."""
        predicted = self.models.predict(INSTANT, pair.q)
        is_outlier = self._learn_except_instant([pair], predicted[None])[0]
        # An outlier gets a step no longer than any other pair.
        longest_m = self._limit_m / OutlierSettings.times_farther if is_outlier else np.inf
        self.models.learn(pair.q, pair.x - predicted, longest_m)
        return not is_outlier

    def learn_instantly(self, pair: Pair) -> None:
        """Teach one pair to the instant learner alone; `learn_pending` teaches the other models.

        It is not yet known if it is an outlier. If it looks like one compared with the pairs before, its step is
        limited to that of any other pair.
        """
        predicted = self.models.predict(INSTANT, pair.q)
        if not math.isfinite(self._limit_m):
            self._limit_m = self.limit_m(pair)
        seems_outlier = float(np.linalg.norm(pair.x - self.map.predict(pair.q))) > self._limit_m
        self.models.learn(
            pair.q, pair.x - predicted, self._limit_m / OutlierSettings.times_farther if seems_outlier else np.inf
        )
        self._pending.append((pair, predicted))

    def learn_pending(self) -> tuple[Sequence[Pair], BoolArray]:
        """Learn the pairs met, as `learn` does; return them with the mask of outliers (n,).

        Stop at an outlier with which a change may have begun: the pairs after it are still `pending`.
        """
        pairs = self.pending
        outliers = self._learn_except_instant(pairs, np.array([predicted for _, predicted in self._pending]))
        self._pending = self._pending[len(outliers) :]
        return pairs[: len(outliers)], outliers

    def _learn_except_instant(self, pairs: Sequence[Pair], instant: FloatArray) -> BoolArray:
        """Teach pairs to all but the instant learner, which predicted `instant` (n, 3) [m]; return the outliers (k,).

        If a change may have begun with an outlier, stop there: k < n.
        """
        q, x = np.array([pair.q for pair in pairs]), np.array([pair.x for pair in pairs])
        variances = np.array([pair.cov.diagonal() for pair in pairs])
        points, predictions = QueryPoints(q), self.models.predictions(q, instant)
        limits = self._limits_m(points, predictions[self.answering], variances)
        outliers = self._classify(q, x, np.linalg.norm(x - predictions[self.answering], axis=1), limits)
        self._limit_m = float(limits[: len(outliers)].max())
        rows = np.flatnonzero(~outliers)
        if len(rows):
            delayed = None if self.models.delayed is None else self.models.delayed.predict(q[rows])
            inlier_predictions = {name: predicted[rows] for name, predicted in predictions.items()}
            self._uncertainty.predicted(points.at(rows), x[rows], inlier_predictions, variances[rows], delayed)
            self._choose()
            self._store_inliers([pairs[row] for row in rows.tolist()], q[rows], x[rows])
        self.monitor.add(*pairs[: len(outliers)], kept=~outliers)
        return outliers

    def _limits_m(self, points: QueryPoints, predicted: FloatArray, variances: FloatArray) -> FloatArray:
        """Return the distance limits (n,) [m] of pairs from their predictions.

        Args:
            points: configurations of the pairs (n, d).
            predicted: predictions (n, 3) [m].
            variances: of the measurements (n, 3) [m²].
        """
        predicted_variance = self._uncertainty.of(self.answering, lambda _: predicted).variance_at(points).sum(axis=1)
        recent = np.maximum(self._uncertainty.errors[self.answering].rms_m, np.sqrt(variances.sum(axis=1)))
        return limits_m(recent, np.sqrt(predicted_variance))

    def _classify(self, q: FloatArray, x: FloatArray, distances_m: FloatArray, limits_m: FloatArray) -> BoolArray:
        outliers: list[bool] = []
        for pair in zip(q, x, distances_m.tolist(), limits_m.tolist(), strict=True):
            outliers.append(self.gate.classify(*pair))
            if outliers[-1] and self.gate.possibly_changed:
                break
        return np.array(outliers)

    def _store_inliers(self, pairs: Sequence[Pair], q: FloatArray, x: FloatArray) -> None:
        turned = [pair for pair in pairs if pair.R is not None]
        turns = np.array([NO_TURN if pair.R is None else pair.R for pair in pairs]) if turned else None
        for pair in turned:
            self._learn_turn(pair.q, pair.R, pair.cov_R)
        self._store(q, x, np.array([pair.cov for pair in pairs]), turns)
        self._replays_due += self._replays_per_pair * len(pairs)

    def learn_deferred(
        self, q: FloatArray, x: FloatArray, cov: FloatArray, turns: FloatArray, belief: ChainBelief
    ) -> None:
        """Learn pairs, q (n, d) and x (n, 3), that waited for the prior: each once, in order.

        Args:
            cov, turns: as in `PairMemory.append`.
            belief: posterior of the chain from them.
        """
        self._uncertainty.fitted(belief)
        variances = np.full((1, 3), belief.noise**2)
        for row_q, row_x, row_cov, turn in zip(q, x, cov, turns, strict=True):
            predicted = self.models.predict(INSTANT, row_q)
            predictions = self.models.predictions(row_q[None], predicted[None])
            self._uncertainty.predicted(QueryPoints(row_q[None]), row_x[None], predictions, variances)
            self.models.learn(row_q, row_x - predicted, np.inf)
            self._learn_turn(row_q, turn)
            self._store(row_q[None], row_x[None], row_cov[None], turn[None])
        self._choose()
        self._replays_due += self._replays_per_pair * len(q)

    def learn_former_outliers(self, q: FloatArray, x: FloatArray) -> None:
        """Learn pairs, q (n, d) and x (n, 3), that were outliers until they began this regime."""
        self._store(q, x)
        self.models.replay(q, x)

    def replay(self) -> int:
        """Take some of the replay steps that are due; return their number."""
        if not self.has_due_replays:
            return 0
        places = self._order.take(min(RegimeSettings.replay_steps, int(self._replays_due)), len(self.memory))
        q, x = self.memory.at(places)
        checked = slice(RegimeSettings.replay_errors)
        self._uncertainty.replayed(x[checked] - self.models.predict(INSTANT, q[checked]))
        self.models.replay(q, x)
        self._replays_due -= len(places)
        return len(places)

    def drop_outliers(self, prior: KBMap) -> int:
        """Drop those of the first pairs that contradict `prior`, a robust fit to them; return their number.

        They may still belong to the old tool.
        """
        (q, x), cov, turns = self.memory.all(), self.memory.cov_since(0), self.memory.turns_since(0)
        inliers = inlier_mask(np.linalg.norm(x - prior.predict(q), axis=1), self._uncertainty.noise_m)
        if inliers.all():
            return 0
        self.memory.clear()
        self.memory.append(q[inliers], x[inliers], cov[inliers], turns[inliers])
        self._order.restart()
        self._uncertainty.reset_comparison()
        self.task_number = next(self._task_numbers)
        return int((~inliers).sum())

    def change_prior(self, prior: KBMap) -> None:
        """Replace the prior by another one fitted to the same pairs."""
        q, x = self.memory.all()
        self.models.replace_prior(prior, q, x)
        self._uncertainty.record_new_prior(x[-RegimeSettings.recent :] - prior.predict(q[-RegimeSettings.recent :]))
        self._choose_map()
        self._replays_due += self._replays_per_pair * min(len(q), RegimeSettings.recent)

    def request_solution(self) -> None:
        self._uncertainty.record_request()
        self.models.request_solution()
        self.monitor.solution_requested()

    def take(self, solved: Solved, model: LearntModel, fed: int) -> None:
        """Store a solution of this regime's task, for one of the models; the solver has `fed` pairs."""
        self.models.take(solved.name, model)
        q, x, cov = self.memory.spread_before(fed, RegimeSettings.looked_back)
        neighbours = follow_a_path(self.models.prior, q)
        errors, variances = x - model.predict(q), cov.diagonal(axis1=1, axis2=2)
        self._uncertainty.record_solution(
            solved.name, errors, solved.belief, solved.wide, neighbours=neighbours, variances=variances
        )
        self._record_late_errors(solved.name, model, solved.pairs, fed)
        self._choose()
        if self.monitor.needs_reference and solved.pairs == fed:
            self._offer(fed)

    def _offer(self, known: int) -> None:
        """Offer the answering model, learnt from `known` pairs, as the reference of the change monitor."""
        belief, wide = self._uncertainty.belief, self._uncertainty.wide
        if belief is None or wide is None:
            return
        q, x, _ = self.memory.since(known - MonitorSettings.looked_back, MonitorSettings.looked_back)
        uncertainty = self._uncertainty.of(self.answering, self.model.predict)
        variance = self._uncertainty.errors[PRIOR].noise_variance
        residual = self._uncertainty.residual
        self.monitor.offer(Reference(self.model, self.map, belief, wide, residual, uncertainty, known, q, x, variance))

    @property
    def orientation(self) -> OrientationModel | None:
        """Answering model of the marker's orientation; None without any."""
        return self.orientations.model(self._uncertainty.support)

    def continue_from_last_solutions(self) -> None:
        """Use the last solutions instead of the pairs before them, if pairs are no longer kept."""
        if EXACT in self.models.names and not self.memory.complete:
            self._solver_prior = self.models.map(EXACT)
            self.arm = self.arm.updated(self._uncertainty.wide, self._uncertainty.residual)

    def store(self, header: LearningHeader) -> dict[str, FloatArray]:
        """Write the state for `restore` into `header`; return its arrays, without the kept pairs."""
        header.answering, header.replays_due = self.answering, self._replays_due
        header.doubted_in_a_row = self.gate.consecutive
        header.belief = self.arm.chain.to_bytes()
        header.residual = None if self.arm.residual is None else self.arm.residual.to_bytes()
        header.replay_position = self._order.position
        header.orientation = self.orientations.state()
        q, x = self.gate.run()
        return {"doubted_q": q, "doubted_x": x} | {NET_PREFIX + name: net for name, net in self.models.nets().items()}

    def restore(self, header: LearningHeader, arrays: Mapping[str, FloatArray]) -> None:
        """Resume from a state of a regime with this prior and arm."""
        nets = {name.removeprefix(NET_PREFIX): net for name, net in arrays.items() if name.startswith(NET_PREFIX)}
        self.models.restore(nets, self._uncertainty.residual)
        self.memory.restore(arrays["q"], arrays["x"], header.kept_of, arrays.get("cov"), arrays.get("turns"))
        if header.orientation is not None:
            self.orientations.restore(header.orientation)
        self.gate.restore(arrays["doubted_q"], arrays["doubted_x"], header.doubted_in_a_row)
        self.answering, self._replays_due = header.answering, header.replays_due
        self._order.restore(header.replay_position)
        self._choose_map()
        self.continue_from_last_solutions()

    def _record_late_errors(self, name: str, model: LearntModel, pairs: int, fed: int) -> None:
        """Compare a solution on the pairs received while the solver worked: it has not learnt them."""
        q, x, _ = self.memory.since(max(pairs, self.memory.count - RegimeSettings.max_late_pairs))
        if len(q) == 0:
            return
        instant = np.full(x.shape, math.nan)
        new = min(max(self.memory.count - fed, 0), len(q))
        if new and self.models.delayed is not None:
            instant[-new:] = x[-new:] - self.models.delayed.predict(q[-new:])
        restart = len(q) >= RegimeSettings.restart_share * pairs
        self._uncertainty.record_late_errors(name, model.predict, q, x - model.predict(q), instant, restart=restart)

    def _learn_turn(self, q: FloatArray, turn: FloatArray | None, cov: FloatArray | None = None) -> None:
        if turn is not None and np.isfinite(turn).all():
            self.orientations.learn(q, turn, cov, self._uncertainty.support)

    def _store(
        self, q: FloatArray, x: FloatArray, cov: FloatArray | None = None, turns: FloatArray | None = None
    ) -> None:
        self.memory.append(q, x, cov, turns)
        self._uncertainty.learnt(q)

    @property
    def recent(self) -> Recent:
        """Errors of the models on the last pairs, before they learnt them."""
        return self._uncertainty.recent(self.answering)

    def _choose(self) -> None:
        self.answering = self._uncertainty.best(self.answering)
        enough = self.memory.count >= OrientationSettings.min_to_trust
        if self.answering == PRIOR and enough and self._uncertainty.is_untested(RIGID):
            self.answering = RIGID  # the same, after some pairs
        self._choose_map()

    def _choose_map(self) -> None:
        self._answering_map = self._uncertainty.best_map(PRIOR) if self.answering == RESIDUAL else self.answering
