"""Define the parameters of effects: numbers with a name, a unit and a usual size."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Parameter:
    """One number of an effect."""

    name: str  # with its unit, as in `extended.toml` and `diagnosis.json`
    usual: float  # typical size of an effect that is present [the parameter's unit]; start of a search
    nominal: float | None = 0.0  # value without influence; None for a number of time or shape (a moment, a period)
    never_negative: bool = False  # True for a backlash, a spring or a lag, which cannot be negative
    # True for a shape on which the measured position depends smoothly: a period or a time constant, but not a moment
    smooth: bool = False
    positive: bool = False  # True for a period or a length, which cannot be zero either
    below_one: bool = False  # True for a share that remains, from 0 to below 1

    @property
    def is_amount(self) -> bool:
        """True for an amount: the measured position depends on it smoothly, and `nominal` has no influence."""
        return self.nominal is not None


T0 = Parameter("t0", 0.0, None)  # the moment at which an effect begins [s], or the row where a recording has no times


def shifts(usual_m: float) -> tuple[Parameter, ...]:
    return tuple(Parameter(f"{axis}_m", usual_m) for axis in "xyz")


def turns(usual_rad: float) -> tuple[Parameter, ...]:
    """Return the parameters of a rotation vector."""
    return tuple(Parameter(f"r{axis}_rad", usual_rad) for axis in "xyz")


@dataclass(frozen=True, slots=True)
class Place:
    """Indices in q of an effect's joint and, for a coupling, of the joint that causes it."""

    joint: int
    prismatic: bool
    source: int | None = None
