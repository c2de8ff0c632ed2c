"""Change monitor: compares an earlier model's predictions with the pairs that came since."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from bodyschema.interfaces.records import FloatArray, Pair
from bodyschema.learning.model_bank import LearntModel
from bodyschema.learning.uncertainty import PredictiveUncertainty
from kbmaps import ChainBelief, ChangeDetector, ChangeKind, ChangeScore, KBMap, ResidualModel, SharedNoise, WhiteNoise
from kbmaps.changes.detector import DetectorSettings
from kbmaps.variance_components import inverse_roots


class MonitorSettings:
    min_known: int = 100  # Minimum number of pairs of a reference model: with fewer it may be too far off
    # A newer model replaces the reference after half as many pairs as it knows, within these limits. It would absorb a
    # change that took longer to show.
    shortest_trial: int = 50
    longest_trial: int = 1000
    chain_alone_ratio: float = (
        0.1  # a model counts as the chain alone if it is this near to it, over the noise of a pair
    )
    min_noise_m: float = 1e-6  # lower bound of a measurement's noise, whatever it claims [m]
    max_watched: int = 5000  # if no newer model comes, the older half of this many pairs is dropped
    looked_back: int = 1000  # number of the model's own pairs that show its noise
    # An alarm that a bent arm explains is evaluated again when the pairs since the change have grown by this factor, or
    # the alarm's log odds by this much.
    review_change, grown_odds = 1.25, 4.0


@dataclass(frozen=True, eq=False)
class Reference:
    """Model that was not fitted to any monitored pair, with its posterior."""

    model: LearntModel  # the answering model
    map: KBMap  # the best KB-Map
    belief: ChainBelief  # posterior of the chain
    wide: ChainBelief  # the same without the selection of narrower tolerances
    residual: ResidualModel | None  # posterior of the arm beyond that; None without any
    uncertainty: PredictiveUncertainty  # predictive uncertainty of the model
    known: int  # number of pairs it was fitted to
    # q, x: some of the last of these, in their order (n, d) [rad] and (n, 3) [m]
    q: FloatArray
    x: FloatArray
    variance: FloatArray  # of these measurements, as claimed (3,) [m²]

    def offset_from_chain(self, q: FloatArray) -> FloatArray:
        """Return positions (n, 3) [m] of the model at q (n, d) [rad] minus those of the chain."""
        return self.model.predict(q) - self.belief.predict(q)

    def derivatives(self, q: FloatArray) -> FloatArray:
        """Return derivatives of the position by the readings at q (n, d): (n, 3, d) [m/rad; 1 if prismatic]."""
        parameters = self.belief.parameters
        return parameters.linearised(self.belief.mean, q)[1][:, :, parameters.zeros]

    def covariances(self, q: FloatArray, white: FloatArray, claimed: FloatArray) -> FloatArray:
        """Return covariances of errors at q (n, d), without the chain's parameters (n, 3, 3) [m²].

        Noise beyond the claimed one explains part of the model's apparent discrepancy, which is reduced accordingly.

        Args:
            q: joint values (n, d).
            white: covariances of the noise (n, 3, 3).
            claimed: covariances of the measurements (n, 3, 3).
        """
        excess = np.maximum((white - claimed).diagonal(axis1=1, axis2=2), 0.0)
        discrepancy = np.maximum(self.uncertainty.variance_beyond_chain(q) - excess, 0.0)
        return white + np.eye(3) * np.maximum(discrepancy, MonitorSettings.min_noise_m**2)[:, None, :]

    def noise(self, covariances: FloatArray, white: FloatArray) -> SharedNoise:
        """Return the noise of the reference's whitened errors at pairs that it was fitted to.

        Args:
            covariances: covariances of these errors (n, 3, 3) [m²].
            white: covariances of the noise (n, 3, 3) [m²].
        """
        errors = np.matvec(inverse_roots(covariances), self.x - self.model.predict(self.q))
        used = (4 * self.q.shape[1] + 3) * len(self.q) / self.known
        share = 1.0 - float((_traces(white) / _traces(covariances)).mean())
        return SharedNoise.of(errors, used).at_least(SharedNoise.claimed(share))


@dataclass(frozen=True, eq=False)
class DetectedChange:
    reference: Reference  # the model before it
    kinds: tuple[ChangeKind, ...]  # the possible kinds
    noise_m: float  # 1-sigma of a coordinate of one measurement around the model [m]
    shared: float  # number of neighbours that carry as much information as one independent pair
    first: int  # the most probable first pair since the change, of those monitored
    # earliest, latest: its 95 % interval
    earliest: int
    latest: int
    seqs: tuple[int, ...]  # sequence numbers of the monitored pairs (n,)
    kept: tuple[bool, ...]  # True for each of them (n,) that was learnt, False for outliers
    # q, x: the monitored pairs, (n, d) [rad] and (n, 3) [m]
    q: FloatArray
    x: FloatArray
    cov: FloatArray  # their covariances (n, 3, 3) [m²], as claimed
    turns: FloatArray  # their orientations, quaternions (n, 4), NaN where a pair has none


@dataclass(frozen=True, slots=True)
class _MonitoredPair:
    seq: int
    q: FloatArray
    x: FloatArray
    cov: FloatArray
    turn: FloatArray
    kept: bool


@dataclass(frozen=True, eq=False)
class _HeldOutErrors:
    """Distances of pairs from models that did not know them."""

    q: FloatArray  # configurations (n, d) [rad]
    claimed: FloatArray  # covariances of the measurements (n, 3, 3) [m²]
    # each against the prediction from the pairs before it (n, 3) [m], without the model's own uncertainty
    off: FloatArray

    def with_newer(self, other: _HeldOutErrors) -> _HeldOutErrors:
        return _HeldOutErrors(
            *(
                np.concatenate([getattr(self, name), getattr(other, name)])[-DetectorSettings.max_surprises :]
                for name in ("q", "claimed", "off")
            )
        )


class ChangeMonitor:
    """Monitor that compares the pairs since a reference with it, and renews the reference while nothing changes.

    The distance of new pairs from a model can only be measured on pairs that it was not fitted to: on its own pairs, a
    wrong chain looks right. So the first reference is tried out before it can raise an alarm.
    """

    def __init__(self) -> None:
        self._reference: Reference | None = None
        self._candidate: Reference | None = None
        self._candidate_at = self._requested_at = 0
        self._pairs: list[_MonitoredPair] = []
        self._dropped_pairs: deque[_MonitoredPair] = deque(maxlen=MonitorSettings.looked_back)
        # Compares the pairs with the current reference; None before the first one.
        self.detector: ChangeDetector | None = None
        self._white = WhiteNoise.as_claimed(0)
        self._change: ChangeScore | None = None
        self._next_review_at = 0
        self._log_odds = self._refuted_log_odds = -math.inf
        self._held_out: _HeldOutErrors | None = None

    @property
    def ready(self) -> bool:
        """True if there is a reference that has been tried out."""
        return self.detector is not None and self._held_out is not None

    @property
    def monitored_count(self) -> int:
        """Number of kept pairs, at most `MonitorSettings.max_watched` except for those since an alarm."""
        return len(self._pairs)

    @property
    def alarmed(self) -> bool:
        """True if there was a change that deflections of the arm would not explain."""
        return self._change is not None

    @property
    def needs_reference(self) -> bool:
        """True if the model solved last can become the next reference."""
        return self._candidate is None or self._candidate_at == self._requested_at

    def solution_requested(self) -> None:
        """Record that the solver works on all pairs so far."""
        if self._reference is None and self._candidate is None:
            self._drop(len(self._pairs))  # only pairs after the first reference model count
        self._requested_at = len(self._pairs)

    def offer(self, reference: Reference) -> None:
        """Offer a model of the pairs up to the last `solution_requested`."""
        if reference.known < MonitorSettings.min_known or not self.needs_reference:
            return
        self._candidate, self._candidate_at = reference, self._requested_at

    def add(self, *pairs: Pair, kept: ArrayLike) -> None:
        """Add one or several pairs, learnt or, if not `kept` (n,), outliers."""
        if self._reference is None:
            self._advance_reference()  # not in `offer`: that runs in the background, and this takes a while
        if len(self._pairs) + len(pairs) > MonitorSettings.max_watched and not self.alarmed:
            dropped = len(self._pairs) // 2
            self._drop(dropped)
            self._requested_at, self._candidate_at = (
                max(self._requested_at - dropped, 0),
                max(self._candidate_at - dropped, 0),
            )
            if self._reference is not None:
                self._set_reference(self._reference)
        for pair, learnt in zip(pairs, np.broadcast_to(kept, len(pairs)).tolist(), strict=True):
            turn = np.full(4, np.nan) if pair.R is None else pair.R
            self._pairs.append(_MonitoredPair(pair.seq, pair.q, pair.x, pair.cov, turn, learnt))
        if self.detector is None:
            return
        self._compare(self._pairs[-len(pairs) :])
        if not self.ready:
            if self._reference is not None and len(self._pairs) >= _trial_length(self._reference.known):
                self._record_held_out()
                self._set_reference(self._reference)
        elif self.detector.due:
            self._evaluate(self.detector)
        unseen = len(self._pairs) - self._candidate_at
        if (
            self._candidate is not None
            and self.ready
            and not self.alarmed
            and unseen >= _trial_length(self._candidate.known)
        ):
            self._record_held_out()
            self._advance_reference()

    def refute(self) -> None:
        """Reject the suspected change, until the pairs give more evidence."""
        since = 0 if self._change is None else len(self._pairs) - self._change.onset
        self._change, self._next_review_at = (
            None,
            len(self._pairs) + int((MonitorSettings.review_change - 1.0) * since) + 1,
        )
        self._refuted_log_odds = self._log_odds

    def _evaluate(self, detector: ChangeDetector) -> None:
        change_score = detector.change_score()
        self._log_odds = change_score.log_odds
        due = (
            len(self._pairs) >= self._next_review_at
            or self._log_odds > self._refuted_log_odds + MonitorSettings.grown_odds
        )
        if change_score.alarm and self._change is None and due:
            self._change = detector.score_if_bending()
            if not self._change.alarm:
                self.refute()

    def detected(self, run: int = 0) -> DetectedChange | None:
        """Return the change detected in the pairs; None without a change or a reference.

        Args:
            run: number of the last pairs that have revealed it by other means: it began there at the latest.
        """
        reference, detector = self._reference, self.detector
        if reference is None or detector is None or not self.ready or not (self.alarmed or run):
            return None
        first = earliest = latest = len(self._pairs) - run
        if self._change is not None:
            first, (earliest, latest) = self._change.onset, self._change.interval()
        pairs = self._pairs
        variance = float(_traces(self._measured(reference, pairs)[2]).mean()) / 3.0
        return DetectedChange(
            reference,
            detector.kinds,
            float(np.sqrt(detector.noise.single * variance)),
            detector.noise.whole / detector.noise.single,
            first,
            earliest,
            latest,
            tuple(each.seq for each in pairs),
            tuple(each.kept for each in pairs),
            *_stacked(pairs),
            np.array([each.turn for each in pairs]),
        )

    def _record_held_out(self) -> None:
        """Record the distances of the pairs from a model that was not fitted to them."""
        if self.detector is None or self._reference is None:
            return
        whitened_errors = self.detector.whitened_errors
        pairs = self._pairs[-len(whitened_errors) :]
        q, _, covariances = self._measured(self._reference, pairs)
        # In metres, because the next weighting of pairs may differ.
        off = np.matvec(np.linalg.inv(inverse_roots(covariances)), whitened_errors)
        held_out = _HeldOutErrors(q, _stacked(pairs)[2], off)
        self._held_out = held_out if self._held_out is None else self._held_out.with_newer(held_out)

    def _drop(self, count: int) -> None:
        """Stop monitoring the first `count` pairs; they still contribute to the noise."""
        self._dropped_pairs.extend(self._pairs[:count])
        del self._pairs[:count]

    def _advance_reference(self) -> None:
        if self._candidate is not None:
            self._drop(self._candidate_at)
            self._requested_at, self._candidate_at = max(self._requested_at - self._candidate_at, 0), 0
            self._reference, self._candidate = self._candidate, None
            self._set_reference(self._reference)

    def _set_reference(self, reference: Reference) -> None:
        """Compare all pairs with this reference, with the measured noise."""
        known = [each for each in (*self._dropped_pairs, *self._pairs) if each.kept][-MonitorSettings.looked_back :]
        self._white = WhiteNoise.as_claimed(reference.q.shape[1])
        if known:
            q, x, claimed = _stacked(known)
            self._white = WhiteNoise.of(x - reference.model.predict(q), claimed, reference.derivatives(q))
        q, claimed = reference.q, np.broadcast_to(np.diag(reference.variance), (len(reference.q), 3, 3))
        derivatives = reference.derivatives(q)
        white = self._white.covariances(claimed, derivatives)
        covariances = reference.covariances(q, white, claimed)
        measured_noise = (
            reference.noise(covariances, white)
            if self._held_out is None
            else self._held_out_noise(reference, self._held_out)
        )
        roots = inverse_roots(covariances)
        reading_share = float(_traces(roots @ self._white.of_readings(derivatives) @ roots).mean()) / 3.0
        noise = measured_noise.at_least(SharedNoise.repeated(reading_share).times(measured_noise.single))
        noise_m = float(np.sqrt(noise.single * _traces(covariances).mean() / 3.0))
        distance_m = float(np.linalg.norm(reference.x, axis=1).mean())
        self.detector = ChangeDetector(reference.belief, noise, noise_m, distance_m)
        if float(np.square(reference.offset_from_chain(q)).mean()) < (MonitorSettings.chain_alone_ratio * noise_m) ** 2:
            # Terms that another model learnt from these pairs would hide the arm's bends.
            self.detector.set_fitted_pairs(q, reference.x - reference.belief.predict(q), covariances)
        self._change, self._next_review_at = None, 0
        self._log_odds = self._refuted_log_odds = -math.inf
        self._compare(self._pairs)

    def _held_out_noise(self, reference: Reference, held_out: _HeldOutErrors) -> SharedNoise:
        white = self._white.covariances(held_out.claimed, reference.derivatives(held_out.q))
        covariances = reference.covariances(held_out.q, white, held_out.claimed)
        return SharedNoise.of(np.matvec(inverse_roots(covariances), held_out.off))

    def _compare(self, pairs: Sequence[_MonitoredPair]) -> None:
        if self._reference is not None and self.detector is not None and pairs:
            self.detector.add(*self._measured(self._reference, pairs))

    def _measured(
        self, reference: Reference, pairs: Sequence[_MonitoredPair]
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return joint values (n, d), errors (n, 3) [m] and the covariances of these (n, 3, 3) [m²]."""
        q, x, claimed = _stacked(pairs)
        white = self._white.covariances(claimed, reference.derivatives(q))
        return q, x - reference.model.predict(q), reference.covariances(q, white, claimed)


def _stacked(pairs: Sequence[_MonitoredPair]) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return joint values (n, d), positions (n, 3) and their claimed covariances (n, 3, 3)."""
    return (
        np.array([each.q for each in pairs]),
        np.array([each.x for each in pairs]),
        np.array([each.cov for each in pairs]),
    )


def _traces(covariances: FloatArray) -> FloatArray:
    return np.trace(covariances, axis1=1, axis2=2)


def _trial_length(known: int) -> int:
    return min(max(known // 2, MonitorSettings.shortest_trial), MonitorSettings.longest_trial)
