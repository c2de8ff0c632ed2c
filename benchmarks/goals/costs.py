"""Rows on time and memory."""

from __future__ import annotations

import numpy as np

from benchmarks.goals.goal import Figure, Row, at_most
from benchmarks.goals.study import Study, Values, least, mean
from benchmarks.peers.growth import measure
from benchmarks.speed import STAGES, exact_costs, online_costs, some_pairs, start_map

_ROUNDS = 20
_TOLERANCE = 1.1


def _online(seed: int) -> Values:
    return online_costs(*some_pairs(np.random.default_rng(seed)), rounds=_ROUNDS)


def _exact(seed: int) -> Values:
    costs, megabytes = exact_costs(start_map(), np.random.default_rng(seed))
    values: dict[str, float] = {"MB": megabytes}
    for cost in costs:
        values |= {f"learn {cost.pairs}": cost.learn, f"ridge {cost.pairs}": cost.ridge}
        values |= {f"plain {cost.pairs}": cost.plain, f"evidence {cost.pairs}": cost.evidence}
    return values


def _speed_rows() -> list[Row]:
    online, exact = (Study("online costs", _online, seeds=20),), (Study("exact learner's costs", _exact, seeds=3),)

    def us(what: str, name: str, goal: float) -> Figure:
        return Figure(what, online, least(name), at_most(goal, "µs"))

    many = STAGES[-1]
    return [
        Row(
            "nlms",
            "one NLMS update with weights, d = 7, CPU time, best run",
            (
                us("NumPy", "numpy NLMS.learn", 35.0),
                us("compiled", "compiled NLMS.learn", 3.0),
                us("block replay, NumPy, a pair", "numpy NLMS.replay, a pair", 8.0),
            ),
        ),
        Row(
            "exact",
            "exact solver, d = 7, CPU time, best run",
            (
                Figure(f"a pair, {STAGES[-2]:,} to {many:,} pairs", exact, least(f"learn {many}"), at_most(32.0, "µs")),
                Figure("a solve at 600 pairs, ridge given", exact, least("ridge 600"), at_most(100.0, "ms")),
                Figure(f"a solve at {many:,} pairs, ridge given", exact, least(f"ridge {many}"), at_most(100.0, "ms")),
                Figure(
                    f"a solve at {many:,} pairs, ridge by the evidence",
                    exact,
                    least(f"evidence {many}"),
                    at_most(100.0, "ms"),
                ),
                Figure("memory while learning and solving", exact, least("MB"), at_most(120.0, "MB")),
            ),
        ),
        Row(
            "prediction",
            "prediction, d = 7, CPU time, best run",
            (
                us("NumPy", "numpy KBMap.predict", 12.0),
                us("compiled", "compiled KBMap.predict", 1.5),
                us("a row of 600, NumPy", "numpy KBMap.predict, a row of 600", 1.0),
                us("a row of 600, compiled", "compiled KBMap.predict, a row of 600", 1.0),
            ),
        ),
        Row(
            "recursive",
            "recursive rigid chain, d = 7, a pair, CPU time, best run",
            (
                us("compiled", "compiled RecursiveRigidLearner.learn", 8.0),
                us("NumPy", "numpy RecursiveRigidLearner.learn", 300.0),
            ),
        ),
    ]


def _growth(seed: int) -> Values:
    """Return the growth factors of time and memory between sizes, relative to theory."""
    del seed  # each size has its own arms
    entries = {(e.what, e.competitor, e.size): (e.seconds, e.mebibytes) for e in measure([], lambda: False)}
    values: dict[str, float] = {}
    for name, what, competitor, small, large, theory in _GROWTHS:
        below, above = entries[what, competitor, small], entries[what, competitor, large]
        for quantity, low, high, factor in zip(("time", "memory"), below, above, theory, strict=True):
            values[f"{name}: {quantity}"] = high / low / factor
    return values


# Name, what grows, learner, from, to, and the factors of time and memory that theory gives.
_GROWTHS = (
    ("full net, d = 8 to 10", "joints", "nlms", 8, 10, (9.0, 9.0)),
    ("tensor train, d = 15 to 30", "joints", "train", 15, 30, (8.0, 4.0)),
    ("rigid chain, d = 15 to 30", "joints", "rigid", 15, 30, (8.0, 4.0)),
    ("tensor train, n = 300 to 3,000", "pairs", "train", 300, 3000, (10.0, 10.0)),
    ("rigid chain, n = 300 to 3,000", "pairs", "rigid", 300, 3000, (10.0, 10.0)),
)


def _growth_row() -> Row:
    study = (Study("growth, CPU time", _growth, seeds=3),)
    return Row(
        "growth",
        "factor by which CPU time and memory grow, over theory's (the curves: `python -m benchmarks.peers`)",
        tuple(
            Figure(f"{name}: {quantity}", study, mean(f"{name}: {quantity}"), at_most(_TOLERANCE))
            for name, *_ in _GROWTHS
            for quantity in ("time", "memory")
        ),
    )


def rows() -> list[Row]:
    return [*_speed_rows(), _growth_row()]
