"""A potentiometer as the joint's sensor, loaded by the input that reads it."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from bodyschema.effects.encoder import EncoderEffect, Place
from bodyschema.effects.motion import Motion
from bodyschema.effects.parameter import Parameter
from bodyschema.interfaces.records import FloatArray

TRAVEL_RAD = np.radians(300.0)


class PotentiometerLoading(EncoderEffect):
    """The input draws current, so that the wiper reads low between the ends of its travel.

    With s the share of the travel that is read and r the potentiometer's resistance over the input's, the true share
    is s + r·s²·(1 − s) to first order.
    """

    name = "potentiometer_loading"
    turns_only = True

    def parameters(self, prismatic: bool) -> tuple[Parameter, ...]:
        """Return the one parameter: the ratio of the resistances, typically 0.05, never negative."""
        return (Parameter("loading", 0.05, never_negative=True),)

    def columns(self, motion: Motion, place: Place, values: FloatArray) -> FloatArray:
        """Return the derivative (n, 1) [rad] of the true angle with respect to the ratio."""
        share = motion.q[:, [place.joint]] / TRAVEL_RAD + 0.5
        return TRAVEL_RAD * share**2 * (1.0 - share)

    def finding(self, at: str, numbers: Mapping[str, float]) -> str:
        """Return the clause for the verdict."""
        return f"the potentiometer of {at} is loaded: its resistance is {100 * numbers['loading']:.2g} % of the input's"

    def remedy(self, at: str) -> str:
        """Return the recommended repair."""
        return f"Put a buffer between the potentiometer of {at} and the input that reads it"
