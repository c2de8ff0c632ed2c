"""Detection of a change from the errors of a model learnt before it."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from kbmaps.arrays import FloatArray, IntArray
from kbmaps.chains.belief import ChainBelief
from kbmaps.changes.bends import NO_EVIDENCE, BendSettings, log_evidence_of_bends, log_ratios_if_bending
from kbmaps.changes.kinds import JOINT, ChangeKind, KindSettings, change_kinds, log_ratios
from kbmaps.changes.white_noise import SharedNoise
from kbmaps.robust import RobustSettings
from kbmaps.variance_components import inverse_roots


class DetectorSettings:
    # Each of the newest pairs may be the first of a change; older onsets are thinned to this share of their age.
    spacing: float = 0.15
    slots: int = 96
    # The statistic often exceeds its limit by far, most of all for the large changes that it allows for. So the limit
    # may be lower than that number of pairs, by this factor (`python -m benchmarks.false_alarms`).
    overshoot: float = 0.33
    # Number of the newest pairs that decide if the noise has grown.
    recent: int = 50
    clear_sigmas: float = 3.0
    # Normally the statistic is evaluated once per this many pairs. After a pair beyond this many sigmas, or at log odds
    # above this, it is evaluated for each pair.
    evaluate_every: int = 5
    outlier_sigmas: float = 3.0
    evaluate_each_above: float = 4.0
    # Minimum average number of pairs between two false alarms, if the model's uncertainty is correct.
    pairs_between_false_alarms: float = 75_000.0
    max_surprises: int = 3000  # number of the newest errors that are kept


class Onsets:
    """Sums over all pairs, and their values before each onset that is kept.

    Args:
        known: number of known parameters, with an uncertainty.
        changes: number of parameters that may change.
    """

    def __init__(self, known: int, changes: int) -> None:
        self._crossed, self._information = np.zeros((known, changes)), np.zeros((changes, changes))
        self._score = np.zeros(changes)
        self._crossed_before = np.zeros((DetectorSettings.slots, known, changes))
        self._information_before = np.zeros((DetectorSettings.slots, changes, changes))
        self._score_before = np.zeros((DetectorSettings.slots, changes))
        self._onset = np.zeros(DetectorSettings.slots, dtype=np.intp)
        self._slots: list[int] = []
        self._free = list(range(DetectorSettings.slots))
        self.pairs = 0

    @property
    def weights(self) -> FloatArray:
        """Number of pairs that each onset stands for (m,): itself and dropped ones after it."""
        onsets = self._onset[self._slots]
        return np.diff(np.append(onsets, self.pairs)).astype(np.float64)

    def add(self, crossed: FloatArray, information: FloatArray, score: FloatArray) -> None:
        """Add a pair: D'C (k, c), C'C (c, c) and C'r (c,) of its derivatives D, C and its error r."""
        slot = self._free.pop()
        self._onset[slot] = self.pairs
        self._crossed_before[slot], self._information_before[slot] = self._crossed, self._information
        self._score_before[slot] = self._score
        self._slots.append(slot)
        self._crossed += crossed
        self._information += information
        self._score += score
        self.pairs += 1
        self._thin()

    def since(self) -> tuple[IntArray, FloatArray, FloatArray, FloatArray]:
        """Return onsets (m,), ascending, and the sums from each of them on: (m, k, c), (m, c, c) and (m, c)."""
        slots = self._slots
        return (
            self._onset[slots],
            self._crossed - self._crossed_before[slots],
            self._information - self._information_before[slots],
            self._score - self._score_before[slots],
        )

    def _thin(self) -> None:
        """Drop the newest onset, except the first, whose neighbours are near enough to each other for their age."""
        for k in range(len(self._slots) - 2, 0, -1):
            before, after = self._onset[self._slots[k - 1]], self._onset[self._slots[k + 1]]
            if after - before <= DetectorSettings.spacing * (self.pairs - after):
                self._free.append(self._slots.pop(k))
                return
        if not self._free:
            self._free.append(self._slots.pop(1))


@dataclass(frozen=True, eq=False)
class ChangeScore:
    """Probability of a change.

    Attributes:
        log_odds: logarithm of the Shiryaev-Roberts statistic, the sum of all likelihood ratios.
        alarm: True if that exceeds the limit set by `DetectorSettings.pairs_between_false_alarms`.
        onsets: candidate first pairs (m,) of the change, counted from the detector's first.
        shares: probability of each onset (m,), given a change.
        kinds: probability of each kind (k,), in the order of the detector's kinds, given a change.
    """

    log_odds: float
    alarm: bool
    onsets: IntArray
    shares: FloatArray
    kinds: FloatArray

    @property
    def onset(self) -> int:
        """Most probable first pair of the change."""
        return int(self.onsets[self.shares.argmax()])

    def interval(self, probability: float = 0.95) -> tuple[int, int]:
        """Return the first and last pair between which the change began, with this probability."""
        tail = 0.5 * (1.0 - probability)
        low, high = np.searchsorted(np.cumsum(self.shares), [tail, 1.0 - tail]).clip(max=len(self.onsets) - 1)
        # Dropped onsets lie before the next one that is kept.
        return int(self.onsets[low]), int(
            self.onsets[min(high + 1, len(self.onsets) - 1)] - (high + 1 < len(self.onsets))
        )


class ChangeDetector:
    """Detector of a change of the tool, the camera or a joint offset at an unknown pair, of an unknown size.

    The errors r of a model not fitted to any of the pairs are, with the derivatives J of its chain,

        r_i = J_i (c + θ [i ≥ t]) + e_i

    with c the model's own uncertainty (narrowed by these errors), e the noise, partly shared by neighbours, and θ the
    change from pair t on. For each t that is kept and each kind, θ has a likelihood ratio (Willsky and Jones 1976,
    there maximised), averaged over sizes. Their sum over t is the statistic of Shiryaev and Roberts: without a change
    its expectation after n pairs is n. So it first exceeds A after at least A pairs on average (Pollak 1987, "Average
    run lengths of an optimal method of detecting a change in distribution"), and later still because it then exceeds A
    by far.

    Args:
        belief: posterior of the chain from pairs before the first of these.
        noise: noise of the whitened errors.
        noise_m: 1-sigma of a coordinate of one measurement [m]: the scale of small and large changes.
        distance_m: usual distance of the marker from the camera [m].
        pairs_between_false_alarms: lower bound of the mean number of pairs between false alarms.
    """

    def __init__(
        self,
        belief: ChainBelief,
        noise: SharedNoise,
        noise_m: float,
        distance_m: float,
        pairs_between_false_alarms: float = DetectorSettings.pairs_between_false_alarms,
    ) -> None:
        self._belief, self._noise = belief, noise
        self._root = belief.root[:, np.square(belief.root).any(axis=0)]
        self.kinds: tuple[ChangeKind, ...] = change_kinds(belief.parameters, distance_m)
        self._columns = np.concatenate([kind.columns for kind in self.kinds])
        self._units = np.concatenate([kind.units for kind in self.kinds])
        ends = np.cumsum([len(kind.columns) for kind in self.kinds])
        self._zeros = np.array([end - 1 for end, kind in zip(ends, self.kinds, strict=True) if kind.name == JOINT])
        self._places = [slice(end - len(kind.columns), end) for kind, end in zip(self.kinds, ends, strict=True)]
        self._log_shares = np.log([kind.share for kind in self.kinds])
        self._noise_m, self._sizes = noise_m, noise_m * np.array(KindSettings.sizes)
        self._limit = self.log_limit(pairs_between_false_alarms)
        known = self._root.shape[1]
        # A root of the covariance: the difference of two covariances would lose all digits after thousands of pairs.
        self._posterior_root, self._mean = np.eye(known), np.zeros(known)
        self._onsets = Onsets(known, len(self._columns))
        self._differences: deque[float] = deque(maxlen=DetectorSettings.recent)
        self._whitened_errors: deque[FloatArray] = deque(maxlen=DetectorSettings.max_surprises)
        self._rows: deque[tuple[FloatArray, FloatArray, FloatArray, FloatArray]] = deque(maxlen=BendSettings.max_pairs)
        self._last_is_outlier, self._evaluated_at, self._log_odds = False, 0, -math.inf
        self._fitted: tuple[FloatArray, FloatArray, FloatArray] | None = None
        self._bends_before: list[FloatArray] | None = None

    @staticmethod
    def log_limit(pairs_between_false_alarms: float) -> float:
        """Return the log odds above which there is an alarm."""
        return math.log(DetectorSettings.overshoot * pairs_between_false_alarms)

    @property
    def pairs(self) -> int:
        """Number of pairs seen."""
        return self._onsets.pairs

    @property
    def noise(self) -> SharedNoise:
        """Noise of the whitened errors, as given."""
        return self._noise

    @property
    def whitened_errors(self) -> FloatArray:
        """Whitened errors (n, 3) of the newest pairs, n at most `DetectorSettings.max_surprises`.

        Each is against the prediction from the pairs before it. They are in units of the noise, without the model's own
        uncertainty.
        """
        return np.array(self._whitened_errors).reshape(-1, 3)

    def add(self, q: FloatArray, errors: FloatArray, covariances: FloatArray) -> None:
        """Add pairs later than those that the model was fitted to, in order.

        Args:
            q: configurations (n, d) [rad, m].
            errors: measured minus predicted (n, 3) [m].
            covariances: covariances of these errors (n, 3, 3) [m²]: of the measurement, and of the model's error beyond
                its belief.
        """
        for row in zip(*self._whitened(q, errors, covariances), strict=True):
            self._rows.append(row)
            self._add(*row[1:])

    def set_fitted_pairs(self, q: FloatArray, errors: FloatArray, covariances: FloatArray) -> None:
        """Set the pairs to which the belief was fitted, in order: they only show the arm's bends.

        Args:
            q: configurations (n, d) [rad, m].
            errors: measured minus predicted by the believed chain (n, 3) [m].
            covariances: as in `add`.
        """
        self._fitted, self._bends_before = (q, errors, covariances), None

    def _whitened(
        self, q: FloatArray, errors: FloatArray, covariances: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return angles (n, d), derivatives by the belief (n, 3, k) and by changes (n, 3, c), and errors (n, 3)."""
        _, jacobian = self._belief.parameters.linearised(self._belief.mean, q)
        weights = inverse_roots(covariances)
        known = weights @ (jacobian @ self._root)
        changed = weights @ (jacobian[:, :, self._columns] * self._units)
        prismatic = self._belief.parameters.reference.prismatic
        return np.where(prismatic, q / self._belief.parameters.reach, q), known, changed, np.matvec(weights, errors)

    def _add(self, known: FloatArray, changed: FloatArray, error: FloatArray) -> None:
        """Add one pair: whitened derivatives by the belief (3, k) and by changes (3, c), and its error (3,)."""
        expected, root = known @ self._mean, known @ self._posterior_root
        covariance = root @ root.T
        spread = math.sqrt(self._noise.single + float(np.trace(covariance)) / 3.0)
        innovation = error - expected
        innovation = innovation * min(
            1.0, RobustSettings.clipped_sigmas * spread / max(float(np.linalg.norm(innovation)), 1e-300)
        )
        if self._whitened_errors:
            half_square = (
                float(np.square(innovation * math.sqrt(self._noise.single) / spread - self._whitened_errors[-1]).mean())
                / 2.0
            )
            self._differences.append(half_square)
        self._whitened_errors.append(innovation * math.sqrt(self._noise.single) / spread)
        error = expected + innovation
        self._last_is_outlier = float(np.linalg.norm(innovation)) > DetectorSettings.outlier_sigmas * spread
        self._onsets.add(known.T @ changed, changed.T @ changed, changed.T @ error)
        step = np.linalg.solve(covariance + self._noise.whole * np.eye(3), root)
        self._mean = self._mean + self._posterior_root @ (innovation @ step)
        _, lengths, directions = np.linalg.svd(root, full_matrices=False)
        shrinkage = 1.0 - np.sqrt(self._noise.whole / (np.square(lengths) + self._noise.whole))
        self._posterior_root = self._posterior_root - (self._posterior_root @ directions.T * shrinkage) @ directions

    @property
    def due(self) -> bool:
        """True if `change_score` may have grown enough to be worth evaluating."""
        late = self.pairs - self._evaluated_at >= DetectorSettings.evaluate_every
        return self.pairs > self._evaluated_at and (
            late or self._last_is_outlier or self._log_odds > DetectorSettings.evaluate_each_above
        )

    def sums(self) -> tuple[IntArray, FloatArray, FloatArray]:
        """Return the information about all possible changes in the pairs since each onset (m,).

        Changes are in metres of marker motion.

        Returns:
            The onsets, and the information (m, c, c) and score (m, c) of changes in the order of the kinds.
        """
        onsets, crossed, information, score = self._onsets.since()
        noise = self._grown_noise()
        variances = noise.of_runs((self.pairs - onsets).astype(np.float64))
        rooted = self._posterior_root.T @ crossed
        explained = rooted.transpose(0, 2, 1) @ rooted / noise.whole
        information = (information - explained) / variances[:, None, None]
        return onsets, information, (score - np.matvec(crossed.transpose(0, 2, 1), self._mean)) / variances[:, None]

    def change_score(self) -> ChangeScore:
        """Return the probability of a change after the pairs so far, at least one."""
        onsets, information, score = self.sums()
        terms = np.stack([log_ratios(information[:, at, at], score[:, at], self._sizes) for at in self._places], axis=1)
        terms += self._log_shares + np.log(self._onsets.weights)[:, None]
        change_score = self._score_of_terms(onsets, terms)
        self._evaluated_at, self._log_odds = self.pairs, change_score.log_odds
        return change_score

    def score_if_bending(self) -> ChangeScore:
        """Return the probability of a change if the arm may bend, before and after; at least one pair.

        The bends are those that the pairs make probable. It costs some hundred times as much as `change_score`: use it
        only after its alarm.
        """
        angles, known, changed, errors = (np.array(each) for each in zip(*self._rows, strict=True))
        scale = 1.0 / math.sqrt(self._noise.single)
        first = self.pairs - len(angles)
        onsets, onset_weights, terms = log_ratios_if_bending(
            angles,
            scale * errors,
            scale * known,
            scale * self._noise_m * changed[..., self._zeros],
            scale * changed,
            self._places,
            self._sizes,
            max(self.change_score().onset - first, 0),
            self._evidence_of_bends(),
        )
        terms = terms + self._log_shares + np.log(onset_weights)[:, None]
        return self._score_of_terms(onsets + first, terms)

    def _evidence_of_bends(self) -> Sequence[FloatArray | float]:
        """Return the evidence about bends in the pairs to which the belief was fitted."""
        if self._fitted is None:
            return NO_EVIDENCE
        if self._bends_before is None:
            scale = 1.0 / math.sqrt(self._noise.single)
            angles, known, changed, errors = self._whitened(*self._fitted)
            turning = scale * self._noise_m * changed[..., self._zeros]
            self._bends_before = log_evidence_of_bends(angles, scale * errors, scale * known, turning)
        return self._bends_before

    def _score_of_terms(self, onsets: IntArray, terms: FloatArray) -> ChangeScore:
        log_odds = float(np.logaddexp.reduce(terms, axis=None))
        shares = np.exp(terms - log_odds)
        return ChangeScore(log_odds, log_odds > self._limit, onsets, shares.sum(axis=1), shares.sum(axis=0))

    def _grown_noise(self) -> SharedNoise:
        """Return the noise, or more if the newest pairs scatter more, since that is not a change of the arm."""
        if len(self._differences) < DetectorSettings.recent:
            return self._noise
        chance = 1.0 + DetectorSettings.clear_sigmas * math.sqrt(1.0 / DetectorSettings.recent)
        return self._noise.times(max(1.0, float(np.mean(self._differences)) / (self._noise.single * chance)))
