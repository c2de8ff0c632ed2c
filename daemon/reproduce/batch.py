"""Exact learning: figures 4 and 5, and the claim of exactness."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from interfaces.records import FloatArray
from kbmaps import ExactLearner, KBMap, RigidChain, blockwise_precision, follow_a_path, learning_bases

from .arm import arm, uniform, walk
from .experiment import Curve, Experiment, Reading, distances, mm

# The mean length of a noise vector with a unit standard deviation per axis.
MEAN_NOISE = 1.5958

Progress = Callable[[str], None]


@dataclass(frozen=True)
class _Set:
    name: str
    colour: str
    q: FloatArray
    x: FloatArray


def _nothing(chain: RigidChain, range_deg: float) -> KBMap:
    """A map that knows nothing of the arm."""
    half = np.full(chain.joints, np.radians(range_deg))
    bases = learning_bases(-half, half)
    return KBMap(bases, np.zeros((3, *(basis.size for basis in bases))))


def _batch(prior: KBMap, q: FloatArray, x: FloatArray, counts: Sequence[int], sets: Sequence[_Set]) -> list[Curve]:
    """Least squares for the first pairs, for each of the counts: errors on what was learnt, and on other sets."""
    learner, done = ExactLearner(prior), 0
    curves = [Curve("training", "tab:green"), *(Curve(other.name, other.colour) for other in sets)]
    for count in counts:
        learner.learn(q[done:count], x[done:count])
        done = count
        learnt = learner.solve().map
        curves[0].add(count, distances(learnt, q[:count], x[:count]))
        for curve, other in zip(curves[1:], sets, strict=True):
            curve.add(count, distances(learnt, other.q, other.x))
    return curves


def fig4(rng: np.random.Generator, say: Progress) -> Experiment:
    """Batch learning of six joints with 10 mm noise: training, test and extrapolation."""
    sigma, chain = 0.010, arm(6)
    q = uniform(rng, 13_000, 6, 80.0)
    x = chain.positions(q) + sigma * rng.normal(size=(len(q), 3))
    poses = (uniform(rng, 6_000, 6, 80.0), uniform(rng, 6_000, 6, 120.0))
    names = (("test", "tab:blue"), ("extrapolation", "tab:orange"))
    sets = [_Set(*name, p, chain.positions(p)) for name, p in zip(names, poses, strict=True)]
    counts = [800, *range(1_000, 4_000, 200), *range(4_000, 13_001, 1_000)]
    say(f"exact learning of {counts[-1]:,} samples, solved {len(counts)} times")
    curves = _batch(_nothing(chain, 80.0), q, x, counts, sets)
    training, test, extrapolation = curves
    crossing = next(
        (
            n
            for n, of_test, of_training in zip(test.count, test.mean, training.mean, strict=True)
            if of_test <= of_training
        ),
        None,
    )
    readings = [
        Reading("samples until the test error is below the noise", "2,200", ""),
        Reading("  read as mean error < mean length of the noise", "", _samples(test.first_below(MEAN_NOISE * sigma))),
        Reading("  read as test error < training error", "", _samples(crossing)),
        Reading("  read as mean error < standard deviation per axis", "", _samples(test.first_below(sigma))),
        Reading("test error after 13,000 samples", "", mm(test.mean[-1])),
        Reading("extrapolation error after 13,000 samples", "", mm(extrapolation.mean[-1])),
    ]
    notes = [
        "The paper does not say which six joints, whether σ is per axis (read so here) or per vector, and what is "
        "compared with it.",
        "Plain least squares, as in the paper; below twice the 729 control points its errors are large.",
    ]
    return Experiment("fig4", "Figure 4: batch learning, 6 joints, ±80°, σ = 10 mm", "samples", curves, readings, notes)


def fig5(rng: np.random.Generator, say: Progress) -> Experiment:
    """Exact learning of five joints from a hand-guided walk with 20 mm noise."""
    sigma, chain = 0.020, arm(5)
    q = walk(rng, 1_500, chain)
    order = rng.permutation(len(q))
    q_train, q_test = q[np.sort(order[:1_000])], q[order[1_000:]]
    x = chain.positions(q_train) + sigma * rng.normal(size=(len(q_train), 3))
    x_test = chain.positions(q_test) + sigma * rng.normal(size=(len(q_test), 3))
    counts = [*range(300, 1_001, 50)]
    say("exact learning of a guided walk, 1,000 samples")
    test = _Set("test, simulated", "tab:red", q_test, x_test)
    plain = _batch(_nothing(chain, 80.0), q_train, x, counts, [test])[1]
    held = Curve("test, the prior's precision chosen by left-out blocks", "tab:blue")
    for count in counts:
        prior = _nothing(chain, 180.0)
        learner = ExactLearner(prior)
        learner.learn(q_train[:count], x[:count])
        path = follow_a_path(prior, q_train[:count])
        precision = blockwise_precision(prior, q_train[:count], x[:count]) if path else "evidence"
        held.add(count, distances(learner.solve(precision).map, q_test, x_test))
    readings = [
        Reading("test error after 1,000 samples", "not stated", mm(plain.mean[-1]), mm(held.mean[-1])),
        Reading("mean length of the noise, which the test has", "", mm(MEAN_NOISE * sigma)),
    ]
    notes = [
        "The test set is drawn from the same walk, and noisy like the training set, as on the robot.",
        "The paper's second curve is measured on the real robot.",
    ]
    title = "Figure 5: exact learning of a guided walk, 5 joints, σ = 20 mm"
    return Experiment("fig5", title, "samples", [plain, held], readings, notes)


def exactness(rng: np.random.Generator, say: Progress) -> Experiment:
    """As many noise-free samples as control points give the arm back."""
    curves: list[Curve] = []
    readings: list[Reading] = []
    for joints in (5, 6, 7):
        chain, needed = arm(joints), 3**joints
        say(f"{needed:,} noise-free samples of {joints} joints")
        for name, spread, factor in ((f"{joints} joints, ±80°", 80.0, 1), (f"{joints} joints, ±20°", 20.0, 2)):
            q = uniform(rng, factor * needed, joints, spread)
            learner = ExactLearner(_nothing(chain, spread))
            learner.learn(q, chain.positions(q))
            begin = time.perf_counter()
            learnt = learner.solve().map
            took = time.perf_counter() - begin
            far = uniform(rng, 2_000, joints, 80.0)
            curve = Curve(name, f"C{joints}")
            curve.add(len(q), distances(learnt, far, chain.positions(far)))
            curves.append(curve)
            outcome = f"{mm(curve.mean[-1])}, {took:.1f} s"
            readings.append(Reading(f"{len(q):,} samples of {name}", "exact", outcome))
    notes = [
        "Mean error within ±80°, and the time of the solution.",
        "Float64 is the limit: a narrower zone multiplies rounding errors (docs/maths.md).",
    ]
    title = "Exactness: 3^d noise-free samples determine the map"
    return Experiment("exactness", title, "samples", curves, readings, notes, floor_m=1e-15)


def _samples(count: int | None) -> str:
    return "not reached" if count is None else f"{count:,}"
