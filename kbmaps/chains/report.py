"""Results of a calibration: camera pose, tool offset and joint offsets, with 95 % intervals."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from kbmaps.arrays import BoolArray, FloatArray, frozen
from kbmaps.chains.parameters import ChainParameters
from kbmaps.robust import HALF_WIDTH_95

_DEG = math.degrees(1.0)
_MM = 1e3
_AXES = ("x", "y", "z")


@dataclass(frozen=True, eq=False)
class Interval:
    """Most probable values (k,) with the half widths (k,) of their 95 % intervals."""

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
    """Scatter of pairs about a chain."""

    noise: float  # 1-sigma of a measured coordinate [m], estimated or given (their RMS)
    misfit: float  # ratio of the residual to the given noise; about 1 for a rigid chain, 1 if no noise was given
    # degrees of freedom: residual coordinates minus the effective number of parameters. If they are few, `noise` is
    # uncertain.
    freedom: float


@dataclass(frozen=True, eq=False)
class ChainReport:
    """Learnt chain relative to the nominal one, in named quantities.

    Attributes:
        T_measured_nominal: pose (4, 4) of the nominal measurement frame in the real one (hand-eye, camera pose).
        base_rotation: its rotation vector (3) [rad].
        base_translation: its translation (3) [m].
        tool_shift: offset of the tool centre point (3) in the nominal marker frame [m].
        zeros: joint offsets to add to each joint's reading (d) [rad, m].
        widening: factor by which the intervals are wider because the noise was estimated from few pairs (Student's t);
            1 if it was given.
        noise: 1-sigma of a measured coordinate [m], estimated or given (their RMS).
        misfit: ratio of the residual to the given noise; about 1 for a rigid chain, 1 if no noise was given.
        freedom: degrees of freedom: residual coordinates minus the effective number of parameters. If they are few,
            `noise` is uncertain.
        outliers: number of pairs left out.
        determined: number of independent directions of the free parameters that the pairs determine.
        undetermined: names of the free parameters that these pairs did not determine, though they matter: more than
            half of the prior's 1-sigma remains, and it exceeded the noise at the arm's reach. They compensate for each
            other or were never moved; their values rest on the tolerances.
        prismatic: True for each prismatic joint (d,).
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
        lines = [f"{'':<14}{'change':>10}   95 %"]
        lines += _of_axes("base shift", self.base_translation, "mm", _MM)
        lines += _of_axes("base turn", self.base_rotation, "deg", _DEG)
        lines += _of_axes("tool", self.tool_shift, "mm", _MM)
        for k, slides in enumerate(self.prismatic):
            unit, scale = ("mm", _MM) if slides else ("deg", _DEG)
            lines.append(_line(f"joint {k + 1} zero", unit, scale, self.zeros, k))
        lines.append(f"noise {_MM * self.noise:.3g} mm, misfit {self.misfit:.2f}, outliers left out: {self.outliers}")
        lines.append(f"directions of the parameters that the pairs show: {self.determined}")
        if self.undetermined:
            lines.append(f"Not shown, so about as believed before: {', '.join(self.undetermined)}.")
        return "\n".join(lines)


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
    """Return the report on a change (size,) with the RMS deviations of the truth from it (size,).

    Parameters in `hidden` (size,) are reported as undetermined.
    """

    def interval(part: slice) -> Interval:
        return Interval(frozen(change[part]), frozen(HALF_WIDTH_95 * deviation[part]))

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


def _of_axes(name: str, interval: Interval, unit: str, scale: float) -> list[str]:
    return [_line(f"{name} {axis}", unit, scale, interval, k) for k, axis in enumerate(_AXES)]


def _line(name: str, unit: str, scale: float, interval: Interval, k: int) -> str:
    value, half = scale * float(interval.value[k]), scale * float(interval.half_width[k])
    # Adding 0.0 removes the sign of a rounded zero.
    return f"{name:<14}{round(value, 3) + 0.0:>10.3f} ± {half:.3f} {unit}"
