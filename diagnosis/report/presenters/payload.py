"""Present a mass that the URDF lacks."""

from __future__ import annotations

import numpy as np

from .presenter import FoundCause, Presenter, Workshop, listed


class Payload(Presenter):
    """Presenter of a mass that the URDF lacks."""

    effect = "payload"
    noun = "an unknown mass on the hand"

    def finding(self, found: FoundCause) -> str:
        return f"the hand carries {found.numbers['mass_kg']:.2g} kg that the URDF does not have"

    def remedy(self, workshop: Workshop, found: FoundCause) -> str:
        mass = found.numbers["mass_kg"]
        centre = [found.numbers[f"{axis}_kgm"] / max(mass, 1e-9) for axis in "xyz"]
        return (
            f"Weigh what the hand carries and give the link {workshop.robot.robot.marker_link} of the URDF an inertial "
            f"with its mass: {mass:.2g} kg here, with its centre at {listed(np.round(centre, 3))} m. Or take it off."
        )
