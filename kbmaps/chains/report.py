"""What calibration is done for: where the camera stands, where the tool is, where the joints have their zeros."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kbmaps.arrays import BoolArray, FloatArray, frozen
from kbmaps.chains.parameters import ChainParameters
from kbmaps.chains.report_text import report_text

# Of the standard deviation; Gaussian.
_HALF_WIDTH_95 = 1.959964


@dataclass(frozen=True, eq=False)
class Interval:
    """The most probable values (k,) with the half width (k,) of their 95 % intervals."""

    value: FloatArray
    half_width: FloatArray

    @property
    def low(self) -> FloatArray:
        return self.value - self.half_width

    @property
    def high(self) -> FloatArray:
        return self.value + self.half_width


@dataclass(frozen=True)
class Scatter:
    """How pairs lie around a chain.

    Attributes:
        noise: 1-sigma of a measured coordinate [m], estimated or told (their RMS).
        misfit: residual over what the noise explains; about 1 for a rigid chain, 1 where the noise was not told.
        freedom: residual coordinates minus those that the parameters have used up; few make `noise` uncertain.
    """

    noise: float
    misfit: float
    freedom: float


@dataclass(frozen=True, eq=False)
class ChainReport:
    """The learnt chain relative to the nominal one, in the numbers that have names.

    Attributes:
        T_measured_nominal: pose (4, 4) of the nominal measurement frame in the real one (hand-eye, camera pose).
        base_rotation: its rotation vector (3) [rad].
        base_translation: its translation (3) [m].
        tool_shift: move of the tool centre point (3) in the nominal marker frame [m].
        zeros: what has to be added to each joint's reading (d) [rad, m].
        widening: by what the intervals are wider since the noise was estimated from few pairs (Student's); 1 if told.
        noise: 1-sigma of a measured coordinate [m], estimated or told (their RMS).
        misfit: residual over what the noise explains; about 1 for a rigid chain, 1 where the noise was not told.
        freedom: residual coordinates minus those that the parameters have used up; few make `noise` uncertain.
        outliers: how many pairs were left out.
        determined: how many independent directions of the free parameters the pairs show.
        undetermined: names of the free parameters that these pairs did not show, though they matter: more than half of
            what was left open before is still (1-sigma), and it was more than the noise at the arm's reach. They make
            up for each other or were never moved; their values rest on the tolerances.
        prismatic: which joints slide (d,).
    """

    T_measured_nominal: FloatArray
    base_rotation: Interval
    base_translation: Interval
    tool_shift: Interval
    zeros: Interval
    widening: float
    noise: float
    misfit: float
    freedom: float
    outliers: int
    determined: int
    undetermined: tuple[str, ...]
    prismatic: tuple[bool, ...]

    def __str__(self) -> str:
        return report_text(self)


def chain_report(
    parameters: ChainParameters,
    change: FloatArray,
    deviation: FloatArray,
    hidden: BoolArray,
    *,
    scatter: Scatter,
    widening: float,
    outliers: int,
    determined: int,
) -> ChainReport:
    """The report on a change (size,) with the RMS deviations of the truth from it (size,).

    What is `hidden` (size,) is undetermined.
    """

    def interval(part: slice) -> Interval:
        return Interval(frozen(change[part]), frozen(_HALF_WIDTH_95 * deviation[part]))

    names = parameters.names()
    return ChainReport(
        T_measured_nominal=frozen(parameters.base_pose(change)),
        base_rotation=interval(parameters.base_turn),
        base_translation=interval(parameters.base_shift),
        tool_shift=interval(parameters.tool),
        zeros=interval(parameters.zeros),
        widening=widening,
        noise=scatter.noise,
        misfit=scatter.misfit,
        freedom=scatter.freedom,
        outliers=outliers,
        determined=determined,
        undetermined=tuple(names[k] for k in np.flatnonzero(hidden)),
        prismatic=tuple(parameters.reference.prismatic.tolist()),
    )
