"""What an effect is described by: numbers with a name, a unit and a usual size."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Parameter:
    """One number of an effect.

    Attributes:
        name: with its unit, as in `extended.toml` and `diagnosis.json`.
        usual: the size that it has where the effect is there [the parameter's unit]: what a search begins with.
        nominal: its value where it does nothing; None for a number that only says when or how (a moment, a period).
        never_negative: a play, a spring or a lag that is negative is none.
        smooth: of one that only says when or how, whether the measured position depends on it smoothly: a period or a
            time constant, and no moment.
    """

    name: str
    usual: float
    nominal: float | None = 0.0
    never_negative: bool = False
    smooth: bool = False

    @property
    def is_amount(self) -> bool:
        """Whether it says how much: the measured position depends on it smoothly, and at `nominal` nothing happens."""
        return self.nominal is not None
