"""Figure 5: exact learning of five joints, from measured and from simulated data."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from bodyschema.cli.terminal.screen import counted
from bodyschema.interfaces.records import FloatArray
from kbmaps import RigidChain

from .arm import CRUDE, JOINTS, arm, crude_estimate, uniform
from .experiment import MEAN_NOISE, Column, Comparison, Curve, Experiment, Pairs, Panel, Reading, Run, Tests
from .least_squares import REGULARISED, blank_map, plain, regularised
from .measured import Measured, postures
from .models import FROM_NOTHING, SEARCHED, WITH_DRAWING, Knowledge, learn_all
from .walk import walk

SIGMA_M = 0.020
HALF_DEG = 80.0
AS_MEASURED, TRUE = "test points as measured", "true test points"


@dataclass(frozen=True)
class _Data:
    """Training pairs, and test poses with noisy and with true positions."""

    pairs: Pairs
    tests: Tests


def fig5(run: Run, *, train: int = 1_000, test: int = 500) -> Experiment:
    """Run least squares without prior knowledge, on tracked positions and on simulated noisy ones in the same poses."""
    chain = arm(5)
    counts = list(range(300, train + 1, 50))
    run.say(f"a walk of {train + test:,} pairs through the sampler")
    simulated = {
        "uniform within ±80°": _simulated(run.rng, chain, uniform(run.rng, train + test, 5, HALF_DEG), train),
        "poses of a random walk": _simulated(run.rng, chain, _shuffled_walk(run, train + test), train),
    }
    measured, noise_m = None, None
    if run.real:
        run.say(f"{train + test:,} postures, rendered and tracked")
        found = postures(5, train + test, run.seed, run.say)
        measured = _as_measured(found, train)
        simulated = {"the postures measured": _simulated(run.rng, chain, found.q, train), **simulated}
        noise_m = found.noise_m
    run.say("exact learning")
    errors = {name: _least_squares(data, counts) for name, data in simulated.items()}
    paper = [_coloured(next(iter(errors.values()))[AS_MEASURED], "simulated, σ = 20 mm", "tab:red")]
    of_measured = None
    if measured is not None:
        of_measured = _least_squares(measured, counts)
        paper.insert(0, _coloured(of_measured[AS_MEASURED], "measured", "tab:purple"))
    shown = measured or next(iter(simulated.values()))
    models = _models(run, shown, counts)
    panels = [
        Panel("as in the paper: test points noisy as the pairs are", paper, as_paper=True),
        Panel(
            f"other models, against true positions ({'measured' if measured else 'simulated'} pairs)",
            [*(of_model[TRUE] for of_model in models.values())],
        ),
    ]
    readings = [reading for name, curves in errors.items() for reading in _readings(name, curves)]
    if of_measured is not None:
        readings += _measured_readings(of_measured)
    return Experiment(
        "fig5",
        "Figure 5: exact learning, 5 joints, σ = 20 mm and as measured",
        "samples",
        panels,
        readings,
        _comparison(models, (of_measured or next(iter(errors.values()))), train, real=run.real),
        _notes(noise_m),
    )


def _notes(noise_m: float | None) -> list[str]:
    notes = [
        "The paper says neither how its five joints were moved nor whether its test points are noisy. Poses here are "
        f"drawn independently. The simulated noise is {1e3 * MEAN_NOISE * SIGMA_M:.0f} mm long on average, which noisy "
        "test points add to any error. Least squares is linear: with σ per vector all errors are those over √3.",
        "The models with a drawing start from a crude estimate, those from nothing as least squares does.",
    ]
    if noise_m is not None:
        notes.append(
            f"Measured: rendered and tracked in each posture. The tracker errs by {1e3 * noise_m:.2f} mm on average, "
            "the paper's perception by about 20 mm: the two curves are as far apart. In the postures both cameras see "
            "the marker, anywhere in the images; the simulated curve in the same postures shows what that costs."
        )
    return notes


def _simulated(rng: np.random.Generator, chain: RigidChain, q: FloatArray, train: int) -> _Data:
    true = chain.positions(q)
    noisy = true + SIGMA_M * rng.normal(size=true.shape)
    tests = {AS_MEASURED: (q[train:], noisy[train:]), TRUE: (q[train:], true[train:])}
    return _Data((q[:train], noisy[:train]), tests)


def _as_measured(found: Measured, train: int) -> _Data:
    q, x = found.q, found.x
    tests = {AS_MEASURED: (q[train:], x[train:]), TRUE: (q[train:], found.true.positions(q[train:]))}
    return _Data((q[:train], x[:train]), tests)


def _shuffled_walk(run: Run, count: int) -> FloatArray:
    q = walk(run.rng, count, JOINTS[5], say=run.say)
    return q[run.rng.permutation(count)]


def _least_squares(data: _Data, counts: list[int]) -> dict[str, Curve]:
    return plain(blank_map(5, HALF_DEG), data.pairs, counts, data.tests)


def _coloured(curve: Curve, name: str, colour: str) -> Curve:
    return Curve(name, colour, count=curve.count, mean=curve.mean, largest=curve.largest)


def _models(run: Run, data: _Data, counts: list[int]) -> dict[str, dict[str, Curve]]:
    half = np.radians(HALF_DEG)
    early = [n for n in (30, 100, 200, *counts) if n <= counts[-1]]
    drawing = Knowledge(crude_estimate(run.rng, arm(5)), CRUDE, half)
    found = learn_all(WITH_DRAWING, drawing, data.pairs, early, data.tests, styles=("--", "-"), say=run.say)
    enough = [n for n in early if n >= SEARCHED]
    run.say("searching a chain in the first pairs")
    nothing = Knowledge.searched(run.rng, *data.pairs, half)
    found |= learn_all(FROM_NOTHING, nothing, data.pairs, enough, data.tests, styles=("--", "-"), say=run.say)
    solved = counted(run.say, f"{REGULARISED}, fits", enough)
    return found | {REGULARISED: regularised(data.pairs, solved, data.tests, styles=("--", "-"))}


def _readings(poses: str, curves: dict[str, Curve]) -> list[Reading]:
    noisy, true = curves[AS_MEASURED].mean[-1], curves[TRUE].mean[-1]
    what = f"simulated, after {curves[TRUE].count[-1]:,} samples"
    return [
        Reading(what, f"{poses}; σ per axis; noisy test points", "not stated", noisy),
        Reading(what, f"{poses}; σ per axis; true test points", "not stated", true),
        Reading(what, f"{poses}; σ per vector; noisy test points", "not stated", noisy / math.sqrt(3.0)),
    ]


def _measured_readings(curves: dict[str, Curve]) -> list[Reading]:
    what = f"measured, after {curves[TRUE].count[-1]:,} samples"
    return [Reading(what, test, "as simulated", curve.mean[-1]) for test, curve in curves.items()]


def _comparison(
    models: dict[str, dict[str, Curve]], plain_errors: dict[str, Curve], train: int, *, real: bool
) -> Comparison:
    columns = [(test, n) for test in (TRUE, AS_MEASURED) for n in (30, 100, 300, train) if test is TRUE or n == train]
    return Comparison(
        f"mean error of other models on the same {'measured' if real else 'simulated'} pairs",
        [Column(test, n) for test, n in columns],
        {
            "least squares": [plain_errors[test].at(n) for test, n in columns],
            **{name: [of_model[test].at(n) for test, n in columns] for name, of_model in models.items()},
        },
    )
