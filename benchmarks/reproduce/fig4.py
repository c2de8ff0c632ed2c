"""Figure 4: batch learning of six joints with noise; training, test and extrapolation."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import numpy as np

from bodyschema.cli.terminal.screen import counted

from .arm import CRUDE, JOINTS, OTHER_SIX, arm, crude_estimate, uniform
from .experiment import MEAN_NOISE, Column, Comparison, Curve, Experiment, Pairs, Panel, Reading, Run, Tests
from .least_squares import REGULARISED, blank_map, plain, regularised
from .models import FROM_NOTHING, SEARCHED, WITH_DRAWING, Knowledge, learn_all

SIGMA_M = 0.010
HALF_DEG, FAR_DEG = 80.0, 120.0
_PAPER = "about 2,200"


def fig4(run: Run, *, samples: int = 13_000, tests: int = 6_000) -> Experiment:
    """Run least squares on growing subsets of noisy pairs, tested without noise within ±80° and ±120°."""
    pairs, held = _drawn(run.rng, JOINTS[6], samples, tests)
    counts = [n for n in (800, *range(1_000, 4_000, 200), *range(4_000, 13_001, 1_000)) if n <= samples]
    what = f"exact learning, solved after up to {counts[-1]:,} samples"
    training, of_tests = _least_squares(pairs, held, counted(run.say, what, counts))
    few = [n for n in counts if n <= 4_000]
    what = "exact learning with another six joints"
    other = _least_squares(*_drawn(run.rng, OTHER_SIX, few[-1], tests), counted(run.say, what, few))
    compared = [n for n in (30, 100, 300, 1_000, 2_200, 6_000, 13_000) if n <= samples]
    models = _models(run, pairs, held, compared)
    notes = [
        "The paper does not say which six joints, whether σ is per axis or per vector, and what is compared with it. "
        "Least squares is linear: with σ per vector all errors are those of σ per axis over √3.",
        "Plain least squares, as in the paper; below twice the 729 control points its errors are large. The other "
        "models with a drawing start from a crude estimate, those from nothing as plain least squares does.",
    ]
    title = "Figure 4: batch learning, 6 joints, ±80°, σ = 10 mm"
    drawn = [curve for of_model in models.values() for curve in of_model.values()]
    panels = [
        Panel("as in the paper", [_noise_level(counts), training, *of_tests.values()], as_paper=True),
        Panel("other models", drawn, styles={"-": "within ±80°", "--": "within ±120°"}),
    ]
    columns = [(test, n) for test in held for n in compared if n in (30, 100, 300, 2_200, 13_000)]
    table = Comparison(
        "mean error of other models on the same pairs",
        [Column(test, n) for test, n in columns],
        {
            "least squares": [of_tests[test].at(n) for test, n in columns],
            **{name: [of_model[test].at(n) for test, n in columns] for name, of_model in models.items()},
        },
    )
    return Experiment(
        "fig4",
        title,
        "samples",
        panels,
        _readings(training, of_tests, crossing(other[0], other[1]["test"])),
        table,
        notes,
    )


def crossing(training: Curve, test: Curve) -> int | None:
    """Return the first count at which the mean test error does not exceed the mean training error."""
    means = zip(test.count, test.mean, training.mean, strict=True)
    return next((count for count, of_test, of_training in means if of_test <= of_training), None)


def _drawn(rng: np.random.Generator, joints: Sequence[str], samples: int, tests: int) -> tuple[Pairs, Tests]:
    """Return noisy pairs, and poses within and beyond their range with true positions."""
    chain, d = arm(joints), len(joints)
    q = uniform(rng, samples, d, HALF_DEG)
    x = chain.positions(q) + SIGMA_M * rng.normal(size=(samples, 3))
    near, far = uniform(rng, tests, d, HALF_DEG), uniform(rng, tests, d, FAR_DEG)
    return (q, x), {"test": (near, chain.positions(near)), "extrapolation": (far, chain.positions(far))}


def _least_squares(pairs: Pairs, held: Tests, counts: Iterable[int]) -> tuple[Curve, dict[str, Curve]]:
    """Return the curves of training and tests, in the paper's colours."""
    training = Curve("training", "tab:green")
    return training, plain(blank_map(pairs[0].shape[1], HALF_DEG), pairs, counts, held, training=training)


def _noise_level(counts: Sequence[int]) -> Curve:
    level = Curve("mean length of the noise", "lightgrey")
    for count in (counts[0], counts[-1]):
        level.add_one(count, MEAN_NOISE * SIGMA_M)
    return level


def _models(run: Run, pairs: Pairs, held: Tests, counts: Sequence[int]) -> dict[str, dict[str, Curve]]:
    half = np.radians(HALF_DEG)
    drawing = Knowledge(crude_estimate(run.rng, arm(6)), CRUDE, half)
    found = learn_all(WITH_DRAWING, drawing, pairs, counts, held, say=run.say)
    enough = [n for n in counts if n >= SEARCHED]
    run.say("searching a chain in the first pairs")
    nothing = Knowledge.searched(run.rng, *pairs, half)
    found |= learn_all(FROM_NOTHING, nothing, pairs, enough, held, say=run.say)
    return found | {REGULARISED: regularised(pairs, counted(run.say, f"{REGULARISED}, fits", counts), held)}


def _readings(training: Curve, of_tests: dict[str, Curve], other_crossing: int | None) -> list[Reading]:
    test, extrapolation = of_tests.values()
    until = "samples until the test error is below the noise"
    root = math.sqrt(3.0)
    found = {
        "σ per axis; mean error < mean length of the noise": test.first_below(MEAN_NOISE * SIGMA_M),
        "σ per axis; mean error < σ": test.first_below(SIGMA_M),
        "σ per vector; mean error < σ": test.first_below(root * SIGMA_M),
        "test error < training error, either σ": crossing(training, test),
        "the same, one head and five arm joints": other_crossing,
    }
    last = test.count[-1]
    return [
        *(Reading(until, read_as, _PAPER, count, "samples") for read_as, count in found.items()),
        Reading(f"test error after {last:,} samples", "σ per axis", "not stated", test.mean[-1]),
        Reading(f"test error after {last:,} samples", "σ per vector", "not stated", test.mean[-1] / root),
        Reading(f"extrapolation error after {last:,} samples", "σ per axis", "not stated", extrapolation.mean[-1]),
        Reading(f"training error after {last:,} samples", "σ per axis", "level of the noise", training.mean[-1]),
    ]
