"""Regime: the models learnt with one tool on top of one prior."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from bodyschema.interfaces.records import FloatArray, Pair
from bodyschema.learning.changes.known_arm import KnownArm
from bodyschema.learning.changes.monitor import ChangeMonitor, MonitorSettings, Reference
from bodyschema.learning.changes.outlier_gate import OutlierGate, OutlierSettings, limits_m, sound
from bodyschema.learning.config import LearnerConfig
from bodyschema.learning.model_bank import EXACT, INSTANT, PRIOR, RESIDUAL, RIGID, LearntModel, ModelBank
from bodyschema.learning.orientation import OrientationModel, Orientations, OrientationSettings
from bodyschema.learning.replay_memory import PairMemory, Permutations
from bodyschema.learning.solvers.solver import Solved, Task
from bodyschema.learning.state import NET, LearningHeader
from bodyschema.learning.uncertainty import UncertaintyTracker
from bodyschema.learning.variance_terms import QueryPoints
from kbmaps import ChainBelief, KBMap, Recent, follow_a_path


class RegimeSettings:
    # Number of pairs that determine the errors of a refitted prior, and that are replayed on top of it.
    recent: int = 200
    replay_steps: int = 64
    judged_late: int = 100  # maximum number of pairs received during a solve that judge its solution
    # With this share of new pairs, the last solution no longer applies: the new one is judged by these pairs alone.
    judged_anew: float = 0.25
    looked_back_in_replay: int = 4
    looked_back: int = 500  # number of learnt pairs on which a model's fit is assessed


NO_TURN = (math.nan,) * 4

BoolArray = NDArray[np.bool_]


class Regime:
    """Learner of the models of one tool side by side, which chooses the one that answers.

    It has no lock of its own. The results of earlier regimes come as `prior`, `arm` and `claims`.
    """

    def __init__(
        self,
        prior: KBMap,  # the map on top of which to learn
        arm: KnownArm,  # prior of the arm before the first pair
        claims: UncertaintyTracker,  # uncertainties of the models; updated here during the regime
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
        self._claims, self._replays_per_pair = claims, settings.replays_per_pair
        claims.expect(arm.chain)
        self._met: list[tuple[Pair, FloatArray]] = []
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
        known = self._solver_prior
        prior = known or self.models.prior
        return Task(
            self.task_number,
            prior,
            self.arm.chain,
            self.arm.residual,
            prior_stays=known is not None,
            tolerances=self.arm.tolerances,
        )

    @property
    def owes_replays(self) -> bool:
        """True if replay steps are due."""
        return self._replays_due >= 1.0 and len(self.memory) > 0

    @property
    def met(self) -> Sequence[Pair]:
        """Pairs that the instant learner has learnt and that are not evaluated yet."""
        return [pair for pair, _ in self._met]

    def limit_m(self, pair: Pair) -> float:
        """Return the distance from its prediction beyond which the pair is an outlier [m]."""
        where = QueryPoints(pair.q[None])
        predicted = self.models.predict(self.answering, where.q)
        return float(self._limits_m(where, predicted, np.diag(pair.cov)[None])[0])

    def learn(self, pair: Pair) -> bool:
        """Learn one pair and evaluate it; return False if it is an outlier."""
        predicted = self.models.predict(INSTANT, pair.q)
        doubted = self._judged([pair], predicted[None])[0]
        # An outlier gets a step no longer than any other pair.
        longest_m = self._limit_m / OutlierSettings.times_farther if doubted else np.inf
        self.models.learn(pair.q, pair.x - predicted, longest_m)
        return not doubted

    def meet(self, pair: Pair) -> None:
        """Teach one pair to the instant learner alone; `judge` teaches the other models.

        It is not yet known if it is an outlier. If it looks like one compared with the pairs before, its step is
        limited to that of any other pair.
        """
        predicted = self.models.predict(INSTANT, pair.q)
        if not math.isfinite(self._limit_m):
            self._limit_m = self.limit_m(pair)
        far = float(np.linalg.norm(pair.x - self.map.predict(pair.q))) > self._limit_m
        self.models.learn(pair.q, pair.x - predicted, self._limit_m / OutlierSettings.times_farther if far else np.inf)
        self._met.append((pair, predicted))

    def judge(self) -> tuple[Sequence[Pair], BoolArray]:
        """Learn the pairs met, as `learn` does; return them with the mask of outliers (n,).

        Stop at an outlier with which a change may have begun: the pairs after it are still `met`.
        """
        pairs = self.met
        doubted = self._judged(pairs, np.array([predicted for _, predicted in self._met]))
        self._met = self._met[len(doubted) :]
        return pairs[: len(doubted)], doubted

    def _judged(self, pairs: Sequence[Pair], instant: FloatArray) -> BoolArray:
        """Teach pairs to all but the instant learner, which predicted `instant` (n, 3) [m]; return the outliers (k,).

        If a change may have begun with an outlier, stop there: k < n.
        """
        q, x = np.array([pair.q for pair in pairs]), np.array([pair.x for pair in pairs])
        variances = np.array([pair.cov.diagonal() for pair in pairs])
        where, predictions = QueryPoints(q), self.models.predictions(q, instant)
        limits = self._limits_m(where, predictions[self.answering], variances)
        doubted = self._doubted(q, x, np.linalg.norm(x - predictions[self.answering], axis=1), limits)
        self._limit_m = float(limits[: len(doubted)].max())
        rows = np.flatnonzero(~doubted)
        if len(rows):
            delayed = None if self.models.delayed is None else self.models.delayed.predict(q[rows])
            shown = {name: predicted[rows] for name, predicted in predictions.items()}
            self._claims.predicted(where.at(rows), x[rows], shown, variances[rows], delayed)
            self._choose()
            self._keep_judged([pairs[row] for row in rows.tolist()], q[rows], x[rows])
        self.monitor.add(*pairs[: len(doubted)], kept=~doubted)
        return doubted

    def _limits_m(self, where: QueryPoints, predicted: FloatArray, variances: FloatArray) -> FloatArray:
        """Return the distance limits (n,) [m] of pairs from their predictions.

        Args:
            where: configurations of the pairs (n, d).
            predicted: predictions (n, 3) [m].
            variances: of the measurements (n, 3) [m²].
        """
        claimed = self._claims.of(self.answering, lambda _: predicted).variance_there(where).sum(axis=1)
        recent = np.maximum(self._claims.errors[self.answering].rms_m, np.sqrt(variances.sum(axis=1)))
        return limits_m(recent, np.sqrt(claimed))

    def _doubted(self, q: FloatArray, x: FloatArray, distances_m: FloatArray, limits_m: FloatArray) -> BoolArray:
        doubted: list[bool] = []
        for pair in zip(q, x, distances_m.tolist(), limits_m.tolist(), strict=True):
            doubted.append(self.gate.doubt(*pair))
            if doubted[-1] and self.gate.perhaps_changed:
                break
        return np.array(doubted)

    def _keep_judged(self, pairs: Sequence[Pair], q: FloatArray, x: FloatArray) -> None:
        turned = [pair for pair in pairs if pair.R is not None]
        turns = np.array([NO_TURN if pair.R is None else pair.R for pair in pairs]) if turned else None
        for pair in turned:
            self._learn_turn(pair.q, pair.R, pair.cov_R)
        self._keep(q, x, np.array([pair.cov for pair in pairs]), turns)
        self._replays_due += self._replays_per_pair * len(pairs)

    def learn_waiting(
        self, q: FloatArray, x: FloatArray, cov: FloatArray, turns: FloatArray, belief: ChainBelief
    ) -> None:
        """Learn pairs, q (n, d) and x (n, 3), that waited for the prior: each once, in order.

        Args:
            cov, turns: as in `PairMemory.append`.
            belief: posterior of the chain from them.
        """
        self._claims.fitted(belief)
        variances = np.full((1, 3), belief.noise**2)
        for row_q, row_x, row_cov, turn in zip(q, x, cov, turns, strict=True):
            predicted = self.models.predict(INSTANT, row_q)
            predictions = self.models.predictions(row_q[None], predicted[None])
            self._claims.predicted(QueryPoints(row_q[None]), row_x[None], predictions, variances)
            self.models.learn(row_q, row_x - predicted, np.inf)
            self._learn_turn(row_q, turn)
            self._keep(row_q[None], row_x[None], row_cov[None], turn[None])
        self._choose()
        self._replays_due += self._replays_per_pair * len(q)

    def begin_with(self, q: FloatArray, x: FloatArray) -> None:
        """Learn pairs, q (n, d) and x (n, 3), that were outliers until they began this regime."""
        self._keep(q, x)
        self.models.replay(q, x)

    def replay(self) -> int:
        """Take some of the replay steps that are due; return their number."""
        if not self.owes_replays:
            return 0
        places = self._order.take(min(RegimeSettings.replay_steps, int(self._replays_due)), len(self.memory))
        q, x = self.memory.at(places)
        seen = slice(RegimeSettings.looked_back_in_replay)
        self._claims.replayed(x[seen] - self.models.predict(INSTANT, q[seen]))
        self.models.replay(q, x)
        self._replays_due -= len(places)
        return len(places)

    def set_aside(self, prior: KBMap) -> int:
        """Drop those of the first pairs that contradict `prior`, a robust fit to them; return their number.

        They may still belong to the old tool.
        """
        (q, x), cov, turns = self.memory.all(), self.memory.cov_since(0), self.memory.turns_since(0)
        belongs = sound(np.linalg.norm(x - prior.predict(q), axis=1), self._claims.noise_m)
        if belongs.all():
            return 0
        self.memory.clear()
        self.memory.append(q[belongs], x[belongs], cov[belongs], turns[belongs])
        self._order.restart()
        self._claims.forget_contest()
        self.task_number = next(self._task_numbers)
        return int((~belongs).sum())

    def change_prior(self, prior: KBMap) -> None:
        """Replace the prior by another one fitted to the same pairs."""
        q, x = self.memory.all()
        self.models.start_again(prior, q, x)
        self._claims.prior_changed(x[-RegimeSettings.recent :] - prior.predict(q[-RegimeSettings.recent :]))
        self._choose_map()
        self._replays_due += self._replays_per_pair * min(len(q), RegimeSettings.recent)

    def ask(self) -> None:
        self._claims.solution_asked()
        self.models.ask()
        self.monitor.asked()

    def take(self, solved: Solved, model: LearntModel, fed: int) -> None:
        """Store a solution of this regime's task, for one of the models; the solver has `fed` pairs."""
        self.models.take(solved.name, model)
        q, x, cov = self.memory.some(fed, RegimeSettings.looked_back)
        neighbours = follow_a_path(self.models.prior, q)
        errors, variances = x - model.predict(q), cov.diagonal(axis1=1, axis2=2)
        self._claims.solution_taken(
            solved.name, errors, solved.belief, solved.wide, neighbours=neighbours, variances=variances
        )
        self._judge_late(solved.name, model, solved.pairs, fed)
        self._choose()
        if self.monitor.wants_reference and solved.pairs == fed:
            self._offer(fed)

    def _offer(self, known: int) -> None:
        """Offer the answering model, learnt from `known` pairs, as the reference of the change monitor."""
        belief, wide = self._claims.belief, self._claims.wide
        if belief is None or wide is None:
            return
        q, x, _ = self.memory.since(known - MonitorSettings.looked_back, MonitorSettings.looked_back)
        claim = self._claims.of(self.answering, self.model.predict)
        variance = self._claims.errors[PRIOR].noise_variance
        residual = self._claims.residual
        self.monitor.offer(Reference(self.model, self.map, belief, wide, residual, claim, known, q, x, variance))

    @property
    def orientation(self) -> OrientationModel | None:
        """Answering model of the marker's orientation; None without any."""
        return self.orientations.model(self._claims.support)

    def solve_from_what_is_known(self) -> None:
        """Use the last solutions instead of the pairs before them, if pairs are no longer kept."""
        if EXACT in self.models.names and not self.memory.complete:
            self._solver_prior = self.models.map(EXACT)
            self.arm = self.arm.updated(self._claims.wide, self._claims.residual)

    def store(self, header: LearningHeader) -> dict[str, FloatArray]:
        """Write the state for `restore` into `header`; return its arrays, without the kept pairs."""
        header.answering, header.replays_due = self.answering, self._replays_due
        header.doubted_in_a_row = self.gate.in_a_row
        header.belief = self.arm.chain.to_bytes()
        header.residual = None if self.arm.residual is None else self.arm.residual.to_bytes()
        header.replay_position = self._order.position
        header.orientation = self.orientations.state()
        q, x = self.gate.run()
        return {"doubted_q": q, "doubted_x": x} | {NET + name: net for name, net in self.models.nets().items()}

    def restore(self, header: LearningHeader, arrays: Mapping[str, FloatArray]) -> None:
        """Resume from a state of a regime with this prior and arm."""
        nets = {name.removeprefix(NET): net for name, net in arrays.items() if name.startswith(NET)}
        self.models.restore(nets, self._claims.residual)
        self.memory.restore(arrays["q"], arrays["x"], header.kept_of, arrays.get("cov"), arrays.get("turns"))
        if header.orientation is not None:
            self.orientations.restore(header.orientation)
        self.gate.restore(arrays["doubted_q"], arrays["doubted_x"], header.doubted_in_a_row)
        self.answering, self._replays_due = header.answering, header.replays_due
        self._order.restore(header.replay_position)
        self._choose_map()
        self.solve_from_what_is_known()

    def _judge_late(self, name: str, model: LearntModel, pairs: int, fed: int) -> None:
        """Compare a solution on the pairs received while the solver worked: it has not learnt them."""
        q, x, _ = self.memory.since(max(pairs, self.memory.count - RegimeSettings.judged_late))
        if len(q) == 0:
            return
        instant = np.full(x.shape, math.nan)
        new = min(max(self.memory.count - fed, 0), len(q))
        if new and self.models.delayed is not None:
            instant[-new:] = x[-new:] - self.models.delayed.predict(q[-new:])
        anew = len(q) >= RegimeSettings.judged_anew * pairs
        self._claims.predicted_late(name, model.predict, q, x - model.predict(q), instant, anew=anew)

    def _learn_turn(self, q: FloatArray, turn: FloatArray | None, cov: FloatArray | None = None) -> None:
        if turn is not None and np.isfinite(turn).all():
            self.orientations.learn(q, turn, cov, self._claims.support)

    def _keep(
        self, q: FloatArray, x: FloatArray, cov: FloatArray | None = None, turns: FloatArray | None = None
    ) -> None:
        self.memory.append(q, x, cov, turns)
        self._claims.learnt(q)

    @property
    def recent(self) -> Recent:
        """Errors of the models on the last pairs, before they learnt them."""
        return self._claims.recent(self.answering)

    def _choose(self) -> None:
        self.answering = self._claims.best(self.answering)
        enough = self.memory.count >= OrientationSettings.fewest_to_trust
        if self.answering == PRIOR and enough and self._claims.untried(RIGID):
            self.answering = RIGID  # the same, after some pairs
        self._choose_map()

    def _choose_map(self) -> None:
        self._answering_map = self._claims.best_map(PRIOR) if self.answering == RESIDUAL else self.answering
