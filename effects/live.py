"""Apply the first stage reading by reading while the robot moves, equal to `Simulation.run` on a whole motion."""

from __future__ import annotations

from bodyschema.interfaces.records import FloatArray

from .motion import Motion
from .simulation import Simulation


class LiveEncoders:
    """True joint angles from encoder readings, in the order of the readings.

    Every reading drives a backlash. It starts on the side of the first change; before any change, it is centred.

    Args:
        row_readings: number of readings between rows, for effects that depend on the row before.
    """

    def __init__(self, simulation: Simulation, row_readings: int = 1) -> None:
        self._errors = [
            (place.joint, effect.kind.encoder.live(place, effect.values, row_readings))
            for effect in simulation.all_effects
            if effect.kind.encoder is not None
            for place in [simulation.place(effect)]
        ]

    def true_angles(self, q: FloatArray, t: float, move: FloatArray) -> FloatArray:
        """Return true joint angles (d,) [rad, m] at the readings q (d,) and the time t [s].

        Args:
            move: the move (d,) since the row before, for joints that have not settled.
        """
        angles, motion = q.copy(), Motion.at(q, t)
        for joint, error in self._errors:
            angles[joint] += error.at(motion, float(move[joint]))
        return angles
