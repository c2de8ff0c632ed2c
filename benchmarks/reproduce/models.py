"""Models that learn the same pairs as the paper's method. A tuple below lists them, one line each."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import inf

import numpy as np

from bodyschema.cli.terminal.screen import Say, counted, quiet
from bodyschema.interfaces.records import FloatArray
from kbmaps import (
    ChainTolerances,
    JointBasis,
    RecursiveRigidLearner,
    RigidChain,
    RigidLearner,
    TensorLearner,
    find_chain,
    learning_bases,
)
from kbmaps.model import Model

from .experiment import Curve, Pairs, Tests, distances

# Number of pairs for the search for a chain if the arm is unknown.
SEARCHED = 100
UNKNOWN = ChainTolerances(
    axes=inf, points=inf, zeros=inf, slide_zeros=inf, tool=inf, base_rotation=inf, base_translation=inf
)
# A tensor train's prior needs positive standard deviations; this is small enough [rad, m].
_LEAST_STD = 1e-6
# Permitted deviation of a tensor train from rigidity, relative to that of its link rotations.
_ELLIPSE_SHARE = 0.05


@dataclass(frozen=True)
class Knowledge:
    """Prior knowledge of a model, without the noise.

    Attributes:
        chain: the nominal arm, or the one found from the first pairs.
        tolerances: possible deviation of the real arm from it.
        half_range: each joint's range is ± this [rad].
    """

    chain: RigidChain
    tolerances: ChainTolerances
    half_range: float

    @classmethod
    def searched(cls, rng: np.random.Generator, q: FloatArray, x: FloatArray, half_range: float) -> Knowledge:
        """Find the chain of an unknown arm from its first pairs."""
        return cls(find_chain(q[:SEARCHED], x[:SEARCHED], rng=rng), UNKNOWN, half_range)

    @property
    def bases(self) -> tuple[JointBasis, ...]:
        """Orthonormal bases over the joints' ranges."""
        half = np.full(self.chain.joints, self.half_range)
        return learning_bases(-half, half)


@dataclass(frozen=True)
class Contender:
    """A model with the name, colour and width [points] of its curve.

    Models that are often equally good have clearly different widths.
    """

    name: str
    colour: str
    make: Callable[[Knowledge], Model]
    width: float = 2.0


def _tensor_train_around(known: Knowledge) -> Model:
    may = known.tolerances
    turn = max(may.axes, _LEAST_STD)
    return TensorLearner.around(
        known.chain,
        known.bases,
        turn_std=turn,
        shift_std=max(may.points, _LEAST_STD),
        marker_std=max(may.tool, _LEAST_STD),
        ellipse_std=max(_ELLIPSE_SHARE * turn, _LEAST_STD),
    )


# With a nominal chain.
WITH_DRAWING = (
    Contender("rigid chain", "tab:blue", lambda known: RigidLearner(known.chain, known.tolerances), 5.0),
    Contender(
        "rigid chain, recursive", "tab:cyan", lambda known: RecursiveRigidLearner(known.chain, known.tolerances), 3.2
    ),
    Contender("tensor train", "tab:purple", _tensor_train_around),
)
# Without one, from `Knowledge.searched`.
FROM_NOTHING = (
    Contender("rigid chain, from nothing", "tab:olive", lambda known: RigidLearner(known.chain, known.tolerances), 1.4),
    Contender("tensor train, from nothing", "tab:pink", lambda known: TensorLearner(known.bases)),
)


def learn_all(
    contenders: Sequence[Contender],
    known: Knowledge,
    pairs: Pairs,
    counts: Sequence[int],
    tests: Tests,
    *,
    styles: Sequence[str] = ("-", "--", ":"),
    suffix: str = "",
    say: Say = quiet,
) -> dict[str, dict[str, Curve]]:
    """Return each model's errors after the first pairs q (n, d) [rad] and x (n, 3) [m]: curves by model and test.

    Args:
        counts: numbers of pairs, ascending; 0 is the prediction before the first pair.
        styles: line styles of the tests.
        suffix: suffix of the curves' names.
        say: called with the name of the learning model and its progress.
    """
    q, x = pairs
    found: dict[str, dict[str, Curve]] = {}
    for contender in contenders:
        model, done = contender.make(known), 0
        curves = {
            test: Curve(f"{contender.name}{suffix}", contender.colour, style, contender.width)
            for test, style in zip(tests, styles, strict=False)
        }
        for count in counted(say, f"{contender.name}, fits", counts):
            if count > done:
                model.learn(q[done:count], x[done:count])
                done = count
            for test, curve in curves.items():
                q_test, x_test = tests[test]
                curve.add(count, distances(model.predict(q_test), x_test))
        found[contender.name] = curves
    return found


def spread_counts(first: int, last: int, number: int = 12) -> list[int]:
    """Return at most `number` counts from `first` to `last`, evenly spaced on a logarithmic scale."""
    return sorted({*np.geomspace(first, last, number).round().astype(int).tolist(), last})
