"""The paper's exact method for growing numbers of pairs."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from kbmaps import ExactLearner, KBMap, blockwise_precision, follow_a_path, learning_bases

from .experiment import Curve, Pairs, Tests, distances

# The paper's colours.
COLOURS = {"test": "tab:blue", "extrapolation": "tab:orange"}
REGULARISED = "KB-Map, precision from the pairs"


def blank_map(joints: int, half_range_deg: float) -> KBMap:
    """Return a map without knowledge of the arm, for joints within ± the range."""
    half = np.full(joints, np.radians(half_range_deg))
    bases = learning_bases(-half, half)
    return KBMap(bases, np.zeros((3, *(basis.size for basis in bases))))


def plain(
    prior: KBMap, pairs: Pairs, counts: Iterable[int], tests: Tests, *, training: Curve | None = None
) -> dict[str, Curve]:
    """Fit the first pairs by least squares, for each of the counts; return a curve for each test.

    Args:
        counts: ascending.
        training: receives the errors on the training pairs.
    """
    q, x = pairs
    learner, done = ExactLearner(prior), 0
    curves = {test: Curve(test, COLOURS.get(test, "tab:red")) for test in tests}
    for count in counts:
        learner.learn(q[done:count], x[done:count])
        done = count
        learnt = learner.solve().map
        if training is not None:
            training.add(count, distances(learnt.predict(q[:count]), x[:count]))
        for test, (q_test, x_test) in tests.items():
            curves[test].add(count, distances(learnt.predict(q_test), x_test))
    return curves


def regularised(
    pairs: Pairs, counts: Iterable[int], tests: Tests, *, styles: Sequence[str] = ("-", "--")
) -> dict[str, Curve]:
    """Run the daemon's exact model, which selects the precision of an uninformative prior from the pairs."""
    q, x = pairs
    curves = {test: Curve(REGULARISED, "tab:gray", style) for test, style in zip(tests, styles, strict=False)}
    prior = blank_map(q.shape[1], 180.0)
    learner, done = ExactLearner(prior), 0
    for count in counts:
        learner.learn(q[done:count], x[done:count])
        done = count
        path = follow_a_path(prior, q[:count])
        learnt = learner.solve(blockwise_precision(prior, q[:count], x[:count]) if path else "evidence").map
        for test, curve in curves.items():
            q_test, x_test = tests[test]
            curve.add(count, distances(learnt.predict(q_test), x_test))
    return curves
