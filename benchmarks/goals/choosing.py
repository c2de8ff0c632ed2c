"""The row about choosing the next pose."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

from benchmarks.active_sampling import CHOSEN, PLANNED, RANDOM, SETUPS, Curves, curve, share_of_pairs
from benchmarks.goals.goal import Figure, Row, at_most
from benchmarks.goals.study import Estimate, Measured, Study, Values

# Most pairs of a curve, where poses are anywhere and where they are confined.
_MOST = {"wide": 40, "local": 20}
_LEVELS = {"wide": (10, 20, 40), "local": (20,)}
_WHERE = {"wide": "poses within ±80°", "local": "poses within ±20°, tested within ±80°"}
_WAYS = {PLANNED: "planned together", CHOSEN: "the best of 200 candidates"}


def _curves(name: str, seed: int) -> Values:
    setup, last = SETUPS[name], _MOST[name]
    most = {RANDOM: setup.random_times * last, CHOSEN: last, PLANNED: last}
    return {f"{way} {pairs}": error for way, n in most.items() for pairs, error in curve(setup, seed, way, n).items()}


def _share(way: str, pairs: int) -> Estimate:
    """Estimate the ratio of chosen to random pairs at equal mean error, with a bootstrapped standard error."""

    def estimate(samples: Sequence[Sequence[Values]]) -> Measured:
        chosen, random = (
            Curves.of(
                [
                    {int(name.split()[1]): error for name, error in values.items() if name.startswith(f"{one} ")}
                    for values in samples[0]
                ]
            )
            for one in (way, RANDOM)
        )
        ratio, ratios = share_of_pairs(pairs, chosen, random)
        return Measured(ratio, float(ratios.std()))

    return estimate


def rows() -> list[Row]:
    studies = {name: (Study(f"active sampling, {name}", partial(_curves, name)),) for name in _MOST}
    return [
        Row(
            "choosing",
            "samples at chosen over random poses, for the same error (d = 7, rough nominal model, σ = 10 mm)",
            tuple(
                Figure(f"{_WHERE[name]}, {pairs} pairs, {text}", studies[name], _share(way, pairs), at_most(0.6))
                for name in _MOST
                for way, text in _WAYS.items()
                for pairs in _LEVELS[name]
            ),
        )
    ]
