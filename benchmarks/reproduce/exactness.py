"""Test of exactness: 3ᵈ noise-free samples determine the map."""

from __future__ import annotations

import time

from kbmaps import ExactLearner

from .arm import arm, uniform
from .experiment import Curve, Experiment, Panel, Reading, Run, distances
from .least_squares import blank_map

# Joint range to either side [°], and the number of samples as a multiple of 3ᵈ.
_ZONES = ((80.0, 1, "tab:blue"), (20.0, 2, "tab:orange"))


def exactness(run: Run, *, joints: tuple[int, ...] = (5, 6, 7)) -> Experiment:
    """Recover the arm from as many noise-free samples as control points; from a narrow zone, from twice as many."""
    curves = [
        Curve(f"{'' if factor == 1 else f'{factor} · '}3ᵈ samples from ±{zone:.0f}°", colour)
        for zone, factor, colour in _ZONES
    ]
    readings: list[Reading] = []
    for d in joints:
        chain = arm(d)
        for curve, (zone, factor, _) in zip(curves, _ZONES, strict=True):
            run.say(f"{factor * 3**d:,} noise-free samples of {d} joints within ±{zone:.0f}°")
            q = uniform(run.rng, factor * 3**d, d, zone)
            learner = ExactLearner(blank_map(d, zone))
            learner.learn(q, chain.positions(q))
            begin = time.perf_counter()
            learnt = learner.solve().map
            took = time.perf_counter() - begin
            far = uniform(run.rng, 2_000, d, 80.0)
            curve.add(len(q), distances(learnt.predict(far), chain.positions(far)))
            what = f"{d} joints, {len(q):,} samples from ±{zone:.0f}°"
            readings.append(Reading(what, "mean error within ±80°", "exact", curve.mean[-1]))
            readings.append(Reading(what, "time of the solution", "not stated", took, "s"))
    notes = ["Float64 is the limit: a narrower zone multiplies rounding errors (docs/maths.md)."]
    title = "Exactness: 3ᵈ noise-free samples determine the map"
    panels = [Panel(f"{', '.join(map(str, joints))} joints, tested within ±80°", curves, as_paper=True)]
    return Experiment("exactness", title, "samples", panels, readings, None, notes, floor_m=1e-15)
