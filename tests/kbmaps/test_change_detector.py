"""A change is detected, dated and named from a model's errors; without a change there is no alarm."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from planted_chains import random_chain

from kbmaps import (
    ChainBelief,
    ChainParameters,
    ChainTolerances,
    ChangeDetector,
    SharedNoise,
    any_change,
    change_kinds,
    explanations,
)
from kbmaps.changes.kinds import log_ratios

SIGMA = 0.002
TOLERANCES = ChainTolerances(axes=0.003, points=0.001, zeros=0.003, tool=0.001)
BEFORE, AFTER = 60, 80
KINDS = {"tool": None, "camera": None, "joint": 2}


def isotropic(sigma_m: float, pairs: int) -> np.ndarray:
    """Return isotropic covariances (pairs, 3, 3) [m²]."""
    return np.broadcast_to(sigma_m**2 * np.eye(3), (pairs, 3, 3))


class Arm:
    """An arm that is nominal within its tolerances, on a smooth path that continues after a change."""

    def __init__(self, seed: int, pairs: int = BEFORE + AFTER, speed: float = 1.0) -> None:
        self.rng = np.random.default_rng(seed)
        self.parameters = ChainParameters(random_chain(self.rng, "RRRRR"))
        self.belief = ChainBelief.from_tolerances(self.parameters, TOLERANCES)
        self.truth = self.parameters.standard_deviations(TOLERANCES) * self.rng.normal(size=self.parameters.size)
        phases, speeds = self.rng.uniform(0.0, 6.0, 5), speed * self.rng.uniform(0.03, 0.08, 5)
        self.q = np.sin(speeds * np.arange(pairs)[:, None] + phases)
        self.x = self.parameters.positions(self.truth, self.q) + SIGMA * self.rng.normal(size=(pairs, 3))

    def change(self, kind: str, size_m: float) -> None:
        """Change the positions from the pair `BEFORE` on, by about this size at the marker."""
        chosen = next(
            each for each in change_kinds(self.parameters, 0.5) if (each.name, each.joint) == (kind, KINDS[kind])
        )
        moved = self.truth.copy()
        direction = self.rng.normal(size=len(chosen.columns))
        moved[chosen.columns] += size_m * chosen.units * direction / np.linalg.norm(direction)
        shift = self.parameters.positions(moved, self.q) - self.parameters.positions(self.truth, self.q)
        self.x[BEFORE:] += shift[BEFORE:]

    def bend(self, size_m: float) -> None:
        """Add a smooth random compliance of the joints, about `size_m` at the marker."""
        waves = self.rng.normal(size=(3, self.q.shape[1])) * 0.7
        self.x += size_m * np.sin(waves @ self.q.T + self.rng.uniform(0.0, 6.0, (3, 1))).T

    def err(self, size_m: float) -> None:
        """Make each encoder eccentric: its error is a wave of the joint's turn, of about this size at the marker."""
        phases = self.rng.uniform(0.0, 6.0, self.q.shape[1])
        read_wrongly = self.q + size_m / self.parameters.reach * np.sin(self.q + phases)
        self.x += self.parameters.positions(self.truth, read_wrongly) - self.parameters.positions(self.truth, self.q)

    def detector(self) -> ChangeDetector:
        return ChangeDetector(self.belief, SharedNoise(np.ones(1), 1.0), SIGMA, 0.5)

    def feed(self, detector: ChangeDetector, pairs: slice) -> None:
        q, x = self.q[pairs], self.x[pairs]
        detector.add(q, x - self.belief.predict(q), isotropic(SIGMA, len(q)))

    def noticed(self) -> tuple[ChangeDetector, int]:
        """Return the detector when it raised an alarm, and the number of pairs it had seen."""
        detector = self.detector()
        for k in range(len(self.q)):
            self.feed(detector, slice(k, k + 1))
            if detector.change_score().alarm:
                return detector, k + 1
        raise AssertionError("no alarm")


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.soak) for seed in range(1, 3))])
def test_large_change_is_dated_within_ten_pairs(seed: int, kind: str) -> None:
    arm = Arm(seed)
    arm.change(kind, 10.0 * SIGMA)
    detector, pairs = arm.noticed()
    earliest, latest = detector.change_score().interval()
    assert BEFORE < pairs <= BEFORE + 10
    assert earliest - 2 <= BEFORE <= latest + 2


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.soak) for seed in range(1, 3))])
def test_pairs_since_a_change_identify_its_kind(seed: int, kind: str) -> None:
    arm = Arm(seed)
    arm.change(kind, 10.0 * SIGMA)
    kinds = (*change_kinds(arm.parameters, 0.5), any_change(arm.parameters))
    best = explanations(arm.belief, kinds, arm.q[BEFORE:], arm.x[BEFORE:], SIGMA)[0]
    assert (best.kind.name, best.kind.joint) == (kind, KINDS[kind])


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.soak) for seed in range(1, 3))])
def test_many_noisy_pairs_still_identify_the_single_change(seed: int, kind: str) -> None:
    arm = Arm(seed, BEFORE + 400)
    arm.change(kind, 5.0 * SIGMA)
    kinds = (*change_kinds(arm.parameters, 0.5), any_change(arm.parameters))
    best = explanations(arm.belief, kinds, arm.q[BEFORE:], arm.x[BEFORE:], SIGMA)[0]
    assert (best.kind.name, best.kind.joint) == (kind, KINDS[kind])


def test_no_kind_is_named_when_arm_hardly_moved() -> None:
    arm = Arm(0)
    arm.change("tool", 10.0 * SIGMA)
    kinds = change_kinds(arm.parameters, 0.5)
    here = np.full(3, BEFORE)
    assert explanations(arm.belief, kinds, arm.q[here], arm.x[here], SIGMA)[0].probability < 0.95


def test_probabilities_of_all_kinds_add_up_to_one() -> None:
    arm = Arm(0)
    kinds = (*change_kinds(arm.parameters, 0.5), any_change(arm.parameters))
    found = explanations(arm.belief, kinds, arm.q, arm.x, SIGMA)
    assert sum(each.probability for each in found) == pytest.approx(1.0)


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.soak) for seed in range(1, 3))])
def test_without_a_change_there_is_no_alarm(seed: int) -> None:
    arm = Arm(seed, 400)
    detector = arm.detector()
    for k in range(0, 400, 10):
        arm.feed(detector, slice(k, k + 10))
        assert not detector.change_score().alarm


def test_mean_likelihood_ratio_is_one_without_a_change() -> None:
    # Small sizes: of large ones the mean is made of values too rare to draw.
    rng = np.random.default_rng(0)
    information = np.diag([0.2, 0.5, 1.0])
    score = rng.normal(size=(200_000, 3)) * np.sqrt(np.diag(information))
    ratios = np.exp(log_ratios(np.broadcast_to(information, (len(score), 3, 3)), score, np.array([0.5, 0.8])))
    assert ratios.mean() == pytest.approx(1.0, abs=0.01)


def test_two_consecutive_gross_outliers_raise_no_alarm() -> None:
    arm = Arm(1)
    arm.x[BEFORE : BEFORE + 2] += 1.0
    detector = arm.detector()
    arm.feed(detector, slice(BEFORE + 2))
    assert not detector.change_score().alarm


def test_noise_that_has_doubled_is_no_change() -> None:
    arm = Arm(2, 400)
    arm.x[BEFORE:] += np.sqrt(3.0) * SIGMA * arm.rng.normal(size=(400 - BEFORE, 3))
    detector = arm.detector()
    for k in range(0, 400, 10):
        arm.feed(detector, slice(k, k + 10))
        assert not detector.change_score().alarm


def test_shared_neighbour_errors_raise_the_variance_of_runs() -> None:
    rng = np.random.default_rng(0)
    alone = rng.normal(size=(600, 3))
    shared = alone + np.repeat(rng.normal(size=(60, 3)), 10, axis=0)
    assert SharedNoise.of(alone).whole < 1.5
    assert SharedNoise.of(shared).whole > 6.0


def alarms(arm: Arm, every: int) -> Iterator[tuple[int, bool]]:
    """Yield after how many pairs there is an alarm, and whether it stands if the arm may bend."""
    detector = arm.detector()
    for k in range(0, len(arm.q), every):
        arm.feed(detector, slice(k, k + every))
        if detector.change_score().alarm:
            yield k + every, detector.score_if_bending().alarm


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.soak
def test_compliant_arm_raises_no_lasting_alarm(seed: int) -> None:
    arm = Arm(seed, 200)
    arm.bend(3.0 * SIGMA)
    raised = list(alarms(arm, every=40))
    assert raised
    assert not any(stands for _, stands in raised)


def test_eccentric_encoders_raise_no_lasting_alarm() -> None:
    arm = Arm(0, 200)
    arm.err(8.0 * SIGMA)
    raised = list(alarms(arm, every=40))
    assert raised
    assert not any(stands for _, stands in raised)


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.soak) for seed in range(1, 3))])
def test_earlier_rigid_behaviour_raises_the_odds_of_change(seed: int) -> None:
    arm, earlier = Arm(seed), Arm(seed, 400)
    arm.change("tool", 2.0 * SIGMA)
    unaware, aware = arm.detector(), arm.detector()
    off = earlier.x - earlier.parameters.positions(earlier.truth, earlier.q)
    aware.set_fitted_pairs(earlier.q, off, isotropic(SIGMA, len(off)))
    for detector in (unaware, aware):
        arm.feed(detector, slice(None))
    assert aware.score_if_bending().log_odds > unaware.score_if_bending().log_odds


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.soak) for seed in range(1, 3))])
def test_change_of_compliant_arm_is_detected_and_dated(seed: int) -> None:
    arm = Arm(seed, speed=0.4)
    arm.bend(2.0 * SIGMA)
    arm.change("tool", 10.0 * SIGMA)
    detector = arm.detector()
    arm.feed(detector, slice(BEFORE + 6))
    change_score = detector.score_if_bending()
    assert change_score.alarm
    assert abs(change_score.onset - BEFORE) <= 1


def test_errors_that_the_axes_share_count_once() -> None:
    """A camera is three times as bad along one direction: an error of two sigmas along it is not unusual."""
    arm, along = Arm(0), np.array([2.0, -1.0, 2.0]) / 3.0
    covariances = isotropic(SIGMA, len(arm.q)) + 8.0 * SIGMA**2 * np.outer(along, along)
    turned, plain = arm.detector(), arm.detector()
    error = 6.0 * SIGMA * along
    turned.add(arm.q[:1], error[None], covariances[:1])
    plain.add(arm.q[:1], np.array([[2.0 * SIGMA, 0.0, 0.0]]), isotropic(SIGMA, 1))
    lengths = [float(np.linalg.norm(each.whitened_errors)) for each in (turned, plain)]
    assert lengths[0] == pytest.approx(lengths[1], rel=0.2)


@pytest.mark.parametrize("kind", KINDS)
def test_an_alarm_of_a_rigid_arm_stands(kind: str) -> None:
    arm = Arm(4)
    arm.change(kind, 20.0 * SIGMA)
    raised = alarms(arm, every=5)
    (first, stands), (second, stands_then) = next(raised), next(raised)
    assert first > BEFORE
    assert second == first + 5
    assert stands or stands_then


def test_the_number_of_kept_errors_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("kbmaps.changes.detector.DetectorSettings.max_surprises", 100)
    arm = Arm(0)
    detector = arm.detector()
    arm.feed(detector, slice(None))
    assert detector.whitened_errors.shape == (100, 3)


def test_batched_pairs_give_same_odds_as_single_pairs() -> None:
    arm, one, all_ = Arm(0), Arm(0).detector(), Arm(0).detector()
    arm.feed(all_, slice(50))
    for k in range(50):
        arm.feed(one, slice(k, k + 1))
    assert one.change_score().log_odds == pytest.approx(all_.change_score().log_odds)


@pytest.mark.parametrize("sigma_m", [1e-3, 1e-6, 1e-9])
@pytest.mark.soak
def test_thousands_of_exact_pairs_keep_detector_finite(sigma_m) -> None:
    arm = Arm(0, pairs=3000)
    arm.x = arm.parameters.positions(arm.truth, arm.q)
    detector = ChangeDetector(arm.belief, SharedNoise(np.ones(1), 1.0), sigma_m, 0.5)
    detector.add(arm.q, arm.x - arm.belief.predict(arm.q), isotropic(sigma_m, len(arm.x)))
    assert np.isfinite(detector.whitened_errors).all()
    assert np.isfinite(detector.change_score().log_odds)


def test_zero_residuals_have_a_positive_finite_variance() -> None:
    noise = SharedNoise.of(np.zeros((200, 3)))
    assert noise.single > 0.0
    assert np.isfinite(noise.variances).all()


def test_repeated_noise_averages_out_only_beyond_ten_neighbours() -> None:
    noise = SharedNoise.repeated(1.0)
    of_means = noise.of_runs(np.array([1.0, 5.0, 10.0, 40.0])) / np.array([1.0, 5.0, 10.0, 40.0])
    np.testing.assert_allclose(of_means, [1.0, 1.0, 1.0, 0.25])
