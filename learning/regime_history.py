"""Sequence of regimes since the nominal model: other tools, cameras and joint offsets."""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import msgspec
import numpy as np

from bodyschema.interfaces.records import FloatArray, Pair
from bodyschema.learning.changes.known_arm import Adapted, ArmBeforeChange, KnownArm
from bodyschema.learning.changes.monitor import DetectedChange, MonitorSettings
from bodyschema.learning.changes.outlier_gate import OutlierSettings, inlier_mask, is_explained
from bodyschema.learning.config import LearnerConfig
from bodyschema.learning.model_bank import PRIOR
from bodyschema.learning.nominal import NominalModel, NominalSettings, chain_tolerances
from bodyschema.learning.regime import Regime
from bodyschema.learning.replay_memory import PairMemory
from bodyschema.learning.solvers.solver import fitted_belief
from bodyschema.learning.state import (
    NET_PREFIX,
    PAIR_ARRAYS,
    Counters,
    Curve,
    LearningHeader,
    LearningState,
    StateError,
)
from bodyschema.learning.status import ChangeRecord, KindOfChange, NamingSettings
from bodyschema.learning.uncertainty import UncertaintyTracker
from kbmaps import ChainBelief, ChainTolerances, DegenerateDataError, Explanation, KBMap, RigidChain


@dataclass(frozen=True)
class Fit:
    """Prior that was fitted to pairs."""

    prior: KBMap  # the map on top of which to learn
    # the nominal chain, placed; after a tool change, the chain that gives the orientation of the hand
    chain: RigidChain
    belief: ChainBelief | None = None  # posterior of the chain; None after a tool change, where only the tool is fitted


class Fitting:
    """Scheduler of the fits: the first after few pairs, the others whenever the number of pairs has doubled."""

    def __init__(self, nominal: NominalModel, tolerances: ChainTolerances) -> None:
        self._nominal, self._tolerances = nominal, tolerances
        # nominal chain, placed; after a tool change, the chain that gives the orientation of the hand
        self.chain = nominal.chain
        self._before: KBMap | None = None
        # number of pairs at the next fit; None if nothing is to be fitted
        self.due_at = None if nominal.frame_known else nominal.pairs_to_align
        self.is_first = True  # True if nothing has been fitted yet

    def due(self, pairs: int) -> bool:
        """Return True if it is time to fit."""
        return self.due_at is not None and pairs >= self.due_at

    def change_tool(self, before: KBMap, hand: RigidChain, first_at: int = NominalSettings.pairs_to_refit) -> None:
        """Fit another tool on top of the map `before` from now on, at first to `first_at` pairs.

        Args:
            before: the map to fit on top of.
            hand: a chain that gives the orientation of the hand.
            first_at: number of pairs at the first fit.
        """
        self._before, self.chain, self.due_at, self.is_first = before, hand, first_at, True

    def stop(self, hand: RigidChain) -> None:
        """Stop fitting. `hand` is a chain that gives the orientation of the hand."""
        self._before, self.chain, self.due_at, self.is_first = None, hand, None, False

    def fit(self, q: FloatArray, x: FloatArray, cov: FloatArray) -> Fit | None:
        """Return the prior that fits pairs q (n, d) [rad] and x (n, 3) [m] best; None if they do not determine it.

        With an unknown frame, that is the most probable chain. A frame alone, fitted to an inaccurate nominal chain,
        would absorb the arm's errors near the first pairs, and be far off everywhere else.
        """
        try:
            if self._before is not None:
                return Fit(self._nominal.with_other_tool(self._before, self.chain, q, x), self.chain)
            aligned_chain = self._nominal.aligned_chain(q, x)
        except DegenerateDataError:
            return None
        belief = fitted_belief(self._nominal.belief(aligned_chain, self._tolerances), q, x, cov)
        return Fit(belief.chain.to_kbmap(self._nominal.bases), aligned_chain, belief)

    def completed(self, pairs: int, fit: Fit | None) -> None:
        if fit is None:
            self.due_at = pairs + max(self._nominal.pairs_to_align, NominalSettings.pairs_to_refit)
        else:
            self.due_at, self.chain, self.is_first = 2 * pairs, fit.chain, False

    def arrays(self) -> dict[str, FloatArray]:
        """Return the arrays of a checkpoint, in addition to `due_at` and `is_first`."""
        kept = {"chain_fixed": self.chain.fixed}
        return kept if self._before is None else kept | {"before_change": self._before.net}

    def restore(self, due_at: int | None, is_first: bool, arrays: Mapping[str, FloatArray]) -> None:
        nominal = self._nominal.chain
        self.due_at, self.is_first = due_at, is_first
        self.chain = RigidChain(arrays["chain_fixed"], nominal.axes, nominal.prismatic)
        if "before_change" in arrays:
            self._before = KBMap(self._nominal.bases, arrays["before_change"])


EXPECTED_M = 0.1  # ordinary RMS distance between a nominal model and reality [m]


class Regimes:
    """Sequence of regimes: the first begins when the frame is known, and another one with each change.

    Args:
        nominal: the nominal model, from which learning starts.
        settings: settings of the learner.
        task_numbers: numbers for the solver's tasks that were never used.
    """

    def __init__(self, nominal: NominalModel, settings: LearnerConfig, task_numbers: Iterator[int]) -> None:
        self._nominal, self._settings, self._task_numbers = nominal, settings, task_numbers
        self._fingerprint = nominal.fingerprint(chain_tolerances(settings))
        # uncertainties of its models, including experience from earlier regimes
        self.uncertainty = UncertaintyTracker(nominal.bases, EXPECTED_M)
        self.fitting = Fitting(nominal, chain_tolerances(settings))  # fits of the frame or the tool as a whole
        self.waiting = PairMemory(nominal.joints, settings.replay_capacity)  # the pairs that wait for the first regime
        self.current: Regime | None = None  # the current regime; None before the frame is known
        self.change: ChangeRecord | None = None  # the last change; None if there was none
        self._origin: ArmBeforeChange | None = None
        self._next_review_at = 0

    @classmethod
    def initial(cls, nominal: NominalModel, settings: LearnerConfig, task_numbers: Iterator[int]) -> Regimes:
        """Return the state before any pair."""
        regimes = cls(nominal, settings, task_numbers)
        if nominal.frame_known:
            regimes.current = regimes._regime(nominal.prior, regimes._nominal_arm(nominal.chain))
        return regimes

    @classmethod
    def restored(
        cls, state: LearningState, nominal: NominalModel, settings: LearnerConfig, task_numbers: Iterator[int]
    ) -> Regimes:
        """Return the regimes as they were at the time of `state`.

        Raises:
            StateError: it belongs to another nominal model, or to other tolerances, or has impossible numbers.
        """
        header, arrays = state.header, state.arrays
        regimes = cls(nominal, settings, task_numbers)
        if header.fingerprint != regimes._fingerprint:
            raise StateError(
                "it belongs to another nominal model or to other tolerances: robot.toml or the URDF has changed since"
            )
        if (invalid_array := state.invalid_array()) is not None:
            raise StateError(f"it is of no use: {invalid_array} is not finite or too large")
        regimes.fitting.restore(header.next_fit, header.first_fit, arrays)
        regimes.uncertainty.restore(header.claims, arrays)
        regimes.change = header.change
        if header.belief is None:
            regimes.waiting.restore(arrays["q"], arrays["x"], header.kept_of, arrays.get("cov"), arrays.get("turns"))
        else:
            arm = KnownArm.from_bytes(header.belief, regimes._tolerances, header.residual)
            regimes.current = regimes._regime(KBMap(nominal.bases, arrays[NET_PREFIX + PRIOR]), arm)
            regimes.current.restore(header, arrays)
        return regimes

    def state(self, counters: Counters, curve: Curve) -> LearningState:
        """Return everything that `restored` needs, with the counters."""
        q, x = self.memory.all()
        header = LearningHeader(
            fingerprint=self._fingerprint,
            counters=copy.copy(counters),
            claims=copy.deepcopy(self.uncertainty.state()),
            curve=curve.points,
            curve_stride=curve.stride,
            kept_of=self.memory.count,
            next_fit=self.fitting.due_at,
            first_fit=self.fitting.is_first,
            change=self.change,
        )
        arrays = self.uncertainty.arrays() | self.fitting.arrays() | {"q": q, "x": x}
        for name, values in (("cov", self.memory.cov_since(0)), ("turns", self.memory.turns_since(0))):
            if np.isfinite(values).any():
                arrays[name] = values
        if self.current is not None:
            arrays |= self.current.store(header)
        return LearningState(header, arrays)

    @property
    def memory(self) -> PairMemory:
        return self.waiting if self.current is None else self.current.memory

    def state_before(self, first: int, counters: Counters, curve: Curve) -> LearningState:
        """Return the state without the pairs from number `first` of the current regime on."""
        state = self.state(counters, curve)
        kept = self.memory.place_of(first)
        arrays = {name: array[:kept] if name in PAIR_ARRAYS else array for name, array in state.arrays.items()}
        if "doubted_q" in arrays:
            arrays |= {name: arrays[name][:0] for name in ("doubted_q", "doubted_x")}
        state.header.doubted_in_a_row, state.header.kept_of = 0, min(first, self.memory.count)
        state.header.counters.since_change -= self.memory.count - state.header.kept_of
        return LearningState(state.header, arrays)

    def change_tool(self, regime: Regime) -> None:
        """Begin the regime of another, unknown tool after `regime`."""
        self.current, self._origin = self._regime_of_next_tool(regime, EXPECTED_M), None

    def follow_tool_change(self, regime: Regime, pair: Pair) -> bool:
        """Begin the regime of another tool if the consecutive outliers of `regime` up to `pair` are its first pairs."""
        gate = regime.gate
        if not (gate.changed or (gate.possibly_changed and self._is_tool_displacement(regime, pair))):
            return False
        q, x = gate.run()
        distances = np.linalg.norm(regime.model.predict(q) - x, axis=1)
        self.current = self._regime_of_next_tool(regime, max(float(np.median(distances)), EXPECTED_M), first_fit=len(q))
        self.current.learn_former_outliers(q, x)
        first = pair.seq - len(q) + 1
        self.change, self._origin = ChangeRecord.unidentified(first, pair.seq, self._nominal.joints), None
        return True

    def detected(self, regime: Regime, pair: Pair) -> DetectedChange | None:
        """Return the change detected in the pairs of `regime`, the last of which is `pair`, or None."""
        if not regime.monitor.ready:
            return None
        gate = regime.gate
        together = gate.possibly_changed and self._is_tool_displacement(regime, pair)
        detected = regime.monitor.detected(run=gate.consecutive if gate.changed or together else 0)
        fewest = OutlierSettings.explained_change_pairs
        return None if detected is None or len(detected.q) - detected.first < fewest else detected

    def adapt(self, regime: Regime, detected: DetectedChange) -> bool:
        """Begin the regime after a change, if that improves the held-out predictions of the pairs since."""
        q, x = detected.q[detected.first :], detected.x[detected.first :]
        origin = ArmBeforeChange(detected, regime.arm)
        found = origin.explain(q, x)
        cov = detected.cov[detected.first :]
        if not origin.improves_prediction(found, q, x, cov):
            regime.monitor.refute()
            return False
        self._next_review_at = int(MonitorSettings.review_change * len(q)) + 1
        seqs = (*detected.seqs, detected.seqs[-1] + 1)
        self.change = ChangeRecord(
            first_seq=detected.seqs[detected.first],
            earliest_seq=seqs[detected.earliest],
            latest_seq=seqs[detected.latest],
            noticed_seq=detected.seqs[-1],
            found=True,
            kinds=_kinds_of_change(found),
            moved_m=found[0].moved_m,
        )
        turns = detected.turns[detected.first :]
        self._begin_adapted(regime, origin.adapt(found, q, x, cov), q, x, cov, turns)
        self._origin = origin
        return True

    @property
    def review_due(self) -> bool:
        """True if it is time to identify the change again."""
        return self._origin is not None and self.memory.count >= self._next_review_at

    def review_change(self) -> bool:
        """Identify the change by all pairs since; return True if a different part of the arm is now relearnt."""
        if self._origin is None or self.change is None or self.current is None:
            return False
        origin, previous, (q, x) = self._origin, self.change.named, self.memory.all()
        found = origin.explain(q, x)
        self.change = msgspec.structs.replace(self.change, kinds=_kinds_of_change(found), moved_m=found[0].moved_m)
        named = self.change.named
        other = named is not None and (previous is None or (previous.name, previous.joint) != (named.name, named.joint))
        if other and self.memory.complete:
            cov, turns = self.memory.cov_since(0), self.memory.turns_since(0)
            self._begin_adapted(self.current, origin.adapt(found, q, x, cov), q, x, cov, turns)
        self._next_review_at = int(MonitorSettings.review_change * len(q)) + 1
        if len(q) > NamingSettings.named_within_pairs:
            self._origin = None
        return other

    def _begin_adapted(
        self, regime: Regime, adapted: Adapted, q: FloatArray, x: FloatArray, cov: FloatArray, turns: FloatArray
    ) -> None:
        """Begin the regime that keeps everything except the changed part, with pairs q (n, d), x (n, 3) since then."""
        inliers = inlier_mask(np.linalg.norm(x - adapted.prior.predict(q), axis=1), self.uncertainty.noise_m)
        self.fitting.stop(adapted.belief.chain)
        self.uncertainty.change_tool(
            max(math.sqrt(3.0) * adapted.belief.noise, self.uncertainty.noise_m), regime.answering
        )
        self.current = self._regime(adapted.prior, adapted.arm)
        self.current.learn_deferred(q[inliers], x[inliers], cov[inliers], turns[inliers], adapted.belief)

    def fitted(self, fit: Fit | None, pairs: int) -> int:
        """Continue from a fit to the first `pairs` pairs; return the number of new outliers."""
        is_first = self.fitting.is_first
        self.fitting.completed(pairs, fit)
        if fit is None:
            return 0
        if self.current is None:
            return 0 if fit.belief is None else self._begin_first(fit, fit.belief)
        outliers = self.current.drop_outliers(fit.prior) if is_first else 0
        self.current.change_prior(fit.prior)
        return outliers

    def _begin_first(self, fit: Fit, belief: ChainBelief) -> int:
        """Learn the pairs that waited for the frame, except those that contradict the fit."""
        (q, x), cov, turns = self.waiting.all(), self.waiting.cov_since(0), self.waiting.turns_since(0)
        inliers = inlier_mask(np.linalg.norm(x - fit.prior.predict(q), axis=1), self.uncertainty.noise_m)
        self.waiting.clear()
        self.current = self._regime(fit.prior, self._nominal_arm(fit.chain))
        self.current.learn_deferred(q[inliers], x[inliers], cov[inliers], turns[inliers], belief)
        return int((~inliers).sum())

    def _regime_of_next_tool(
        self, regime: Regime, expected_m: float, first_fit: int = NominalSettings.pairs_to_refit
    ) -> Regime:
        """Return the regime of another tool, which begins where `regime` ends."""
        prior, arm = regime.map, regime.arm.updated(self.uncertainty.wide, self.uncertainty.residual)
        self.fitting.change_tool(prior, self._hand, first_fit)
        self.uncertainty.change_tool(expected_m, regime.answering)
        return self._regime(prior, arm.with_other_tool())

    def _is_tool_displacement(self, regime: Regime, pair: Pair) -> bool:
        """Return True if one other position of the marker on the hand explains the consecutive outliers."""
        expected_m = regime.limit_m(pair) / OutlierSettings.times_farther
        q, x = regime.gate.run()
        predicted = regime.model.predict(q)
        # Without the answering model's terms beyond the map, which hold for any tool.
        x_of_map = x - (predicted - regime.map.predict(q))
        moved = self._nominal.with_other_tool(regime.map, self._hand, q, x_of_map)
        residuals = np.linalg.norm(x_of_map - moved.predict(q), axis=1)
        return is_explained(np.linalg.norm(x - predicted, axis=1), residuals, expected_m)

    @property
    def _hand(self) -> RigidChain:
        """Chain with the best estimate of the hand's orientation."""
        belief = self.uncertainty.belief
        return self.fitting.chain if belief is None else belief.chain

    def _regime(self, prior: KBMap, arm: KnownArm) -> Regime:
        return Regime(prior, arm, self.uncertainty, self._settings, self._task_numbers)

    def _nominal_arm(self, chain: RigidChain) -> KnownArm:
        return KnownArm(self._nominal.belief(chain, chain_tolerances(self._settings)), self._tolerances)

    @property
    def _tolerances(self) -> ChainTolerances:
        return self._nominal.tolerances(chain_tolerances(self._settings))


def _kinds_of_change(found: list[Explanation]) -> list[KindOfChange]:
    return [KindOfChange(each.kind.name, each.kind.joint, each.probability) for each in found]
