"""The models that learn the same pairs as the paper's method. One more is one more line in a tuple here."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import inf

import numpy as np

from bodyschema.daemon.progress import Say, counted, quiet
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

# Pairs from which a chain is searched where nothing is known of the arm.
SEARCHED = 100
UNKNOWN = ChainTolerances(
    axes=inf, points=inf, zeros=inf, slide_zeros=inf, tool=inf, base_rotation=inf, base_translation=inf
)
# A tensor train's prior has no exact numbers; this is near enough [rad, m].
_LEAST_STD = 1e-6
# How far a tensor train may leave rigidity, as a share of how far its links may be turned.
_ELLIPSE_SHARE = 0.05


@dataclass(frozen=True)
class Knowledge:
    """What a model is told before the first pair; the noise is not among it.

    Attributes:
        chain: the arm as drawn, or as searched in the first pairs.
        tolerances: how far the real one may be from it.
        half_range: each joint's range is ± this [rad].
    """

    chain: RigidChain
    tolerances: ChainTolerances
    half_range: float

    @classmethod
    def searched(cls, rng: np.random.Generator, q: FloatArray, x: FloatArray, half_range: float) -> Knowledge:
        """Nothing is known of the arm, so that its first pairs have to tell."""
        return cls(find_chain(q[:SEARCHED], x[:SEARCHED], rng=rng), UNKNOWN, half_range)

    @property
    def bases(self) -> tuple[JointBasis, ...]:
        """Bases orthonormal over the joints' ranges."""
        half = np.full(self.chain.joints, self.half_range)
        return learning_bases(-half, half)


@dataclass(frozen=True)
class Contender:
    """A model under the name, in the colour and in the width [points] of its curve.

    Models that are often equally good have widths far apart.
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


# With a drawing of the arm.
WITH_DRAWING = (
    Contender("rigid chain", "tab:blue", lambda known: RigidLearner(known.chain, known.tolerances), 5.0),
    Contender(
        "rigid chain, recursive",
        "tab:cyan",
        lambda known: RecursiveRigidLearner(known.chain, known.tolerances),
        3.2,
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
    """Each contender's errors after so many of the pairs q (n, d) [rad] and x (n, 3) [m]: curves by model and test.

    Args:
        counts: ascending; 0 is what a model says before the first pair.
        styles: of the tests' lines.
        suffix: what the curves' names end with.
        say: told which contender learns, and how far it is.
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
    """So many counts at most between two, evenly spread over their logarithms."""
    return sorted({*np.geomspace(first, last, number).round().astype(int).tolist(), last})
