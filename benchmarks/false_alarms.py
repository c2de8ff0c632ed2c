"""False alarm rate when the model's uncertainty is correct: `python -m benchmarks.false_alarms [--arms N] [--draws N]`.

An alarm comes once in 75,000 pairs, so waiting for alarms would take too long. Instead, a change is sampled from the
detector's prior (kind, size, direction, any first pair t). The density of such pairs relative to pairs without a change
is then R_n, the statistic itself, summed over t (Wald's likelihood identity). So without a change an alarm comes once
in

    1 / E[1 / R_alarm]

pairs; E is the mean over changes. R_alarm lies beyond the limit, for large changes far beyond it. The detector counts
no pair beyond four sigmas, so its R is smaller, and alarms are rarer still. Printed are this number of pairs for the
detector's own limit, and the factor by which a limit may lie below the number of pairs that it stands for.
"""

from __future__ import annotations

import argparse
import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import math

import numpy as np

from benchmarks.changes import KNOWN, TOLERANCES, reference, walk
from benchmarks.rough_arm import rough_arm
from bodyschema.interfaces.records import FloatArray
from kbmaps import ChangeDetector, SharedNoise
from kbmaps.changes.detector import DetectorSettings
from kbmaps.changes.kinds import KindSettings

QUIET, LONGEST = (20, 120), 600


def inverse_statistics(joints: int, sigma: float, seed: int, draws: int) -> list[float]:
    """Return 1 / R at the alarm for changes of one arm; 0 for a change without an alarm in time."""
    rng = np.random.default_rng([seed, joints, round(1e4 * sigma), 17])
    arm = rough_arm(joints, rng, TOLERANCES)
    known = walk(joints, KNOWN, rng)
    belief = reference(arm, known, arm.measured(known, sigma, rng), noise_of(sigma, KNOWN)).belief
    found: list[float] = []
    for _ in range(draws):
        # A correct posterior: the arm's parameters are sampled from it, and positions are linear in them.
        detector = ChangeDetector(belief, SharedNoise(np.ones(1), 1.0), sigma, 1.0)
        q = walk(joints, QUIET[1] + LONGEST, rng)
        _, jacobian = belief.parameters.linearised(belief.mean, q)
        errors = sigma * rng.normal(size=(len(q), 3)) + jacobian @ (belief.root @ rng.normal(size=belief.root.shape[1]))
        first = int(rng.integers(*QUIET))
        errors[first:] += jacobian[first:] @ drawn_change(detector, belief.parameters.size, sigma, rng)
        found.append(math.exp(-log_statistic(detector, q, errors, sigma, first)))
    return found


def drawn_change(detector: ChangeDetector, size: int, sigma: float, rng: np.random.Generator) -> FloatArray:
    """Sample a change of the parameters (size,) from the detector's prior."""
    kind = detector.kinds[int(rng.choice(len(detector.kinds), p=[each.share for each in detector.kinds]))]
    change = np.zeros(size)
    change[kind.columns] = sigma * rng.choice(KindSettings.sizes) * rng.normal(size=len(kind.columns)) * kind.units
    return change


def log_statistic(detector: ChangeDetector, q: FloatArray, errors: FloatArray, sigma: float, first: int) -> float:
    """Return log R when it first exceeds the limit after pair `first`; infinite if it never does."""
    covariance = noise_of(sigma, 1)
    for k in range(min(first + LONGEST, len(q))):
        detector.add(q[k : k + 1], errors[k : k + 1], covariance)
        if k >= first and detector.due and (change_score := detector.change_score()).alarm:
            return change_score.log_odds
    return math.inf


def noise_of(sigma: float, pairs: int) -> FloatArray:
    """Return the covariances of the pairs (pairs, 3, 3)."""
    return np.broadcast_to(sigma**2 * np.eye(3), (pairs, 3, 3))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--arms", type=int, default=8)
    parser.add_argument("--first", type=int, default=0, help="the first arm's seed")
    parser.add_argument("--draws", type=int, default=10, help="changes of each arm")
    parser.add_argument("--joints", type=int, default=6)
    parser.add_argument("--sigma", type=float, default=5.0, help="[mm]")
    arguments = parser.parse_args()
    inverse = np.concatenate(
        [
            inverse_statistics(arguments.joints, 1e-3 * arguments.sigma, arguments.first + arm, arguments.draws)
            for arm in range(arguments.arms)
        ]
    )
    rate, spread = float(inverse.mean()), float(inverse.std()) / math.sqrt(len(inverse))
    limit = math.exp(ChangeDetector.log_limit(DetectorSettings.pairs_between_false_alarms))
    print(
        f"d = {arguments.joints}, sigma {arguments.sigma:g} mm, {len(inverse)} changes: one false alarm in "
        f"{1.0 / rate:,.0f} pairs ({1.0 / (rate + 2.0 * spread):,.0f} at least, 2 standard errors); "
        f"limit {limit:,.0f}, factor {limit * rate:.2f}"
    )


if __name__ == "__main__":
    main()
