"""Define the parameters of effects: numbers with a name, a unit and a usual size."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Parameter:
    """One number of an effect.

    Attributes:
        name: with its unit, as in `extended.toml` and `diagnosis.json`.
        usual: typical size of an effect that is present [the parameter's unit]; start of a search.
        nominal: value without influence; None for a number of time or shape (a moment, a period).
        never_negative: True for a backlash, a spring or a lag, which cannot be negative.
        smooth: True for a shape on which the measured position depends smoothly: a period or a time constant, but not a
            moment.
    """

    name: str
    usual: float
    nominal: float | None = 0.0
    never_negative: bool = False
    smooth: bool = False

    @property
    def is_amount(self) -> bool:
        """True for an amount: the measured position depends on it smoothly, and `nominal` has no influence."""
        return self.nominal is not None
