"""The first stage while the robot moves: what `Simulation.run` gives for a whole motion, reading by reading."""

from __future__ import annotations

import numpy as np

from interfaces.records import FloatArray

from .effect import Effect
from .encoder import Backlash, Place, Play
from .motion import Motion
from .simulation import Simulation


class LiveEncoders:
    """True joint angles from what the encoders read, in the order in which they read it.

    A play is driven by every reading, and begins where the readings lead first: before any has changed, it is centred.
    """

    def __init__(self, simulation: Simulation) -> None:
        encoder = [effect for effect in simulation.effects if effect.kind.encoder is not None]
        plays = [effect for effect in encoder if isinstance(effect.kind.encoder, Backlash)]
        self._place = simulation.place
        self._plays = [_LivePlay(simulation.place(effect), float(effect.values[0])) for effect in plays]
        self._others = [effect for effect in encoder if effect not in plays]

    def true_angles(self, q: FloatArray, t: float, move: FloatArray) -> FloatArray:
        """True joint angles (d,) [rad, m] at the readings q (d,) and the time t [s].

        Args:
            move: the move (d,) that ended with these readings, for what has not come to rest.
        """
        angles = q.copy()
        motion = Motion(np.stack([q - move, q]), np.array([t, t]), np.zeros(2, dtype=np.int64))
        for effect in self._others:
            angles[self._place(effect).joint] += self._correction(effect, motion)
        for play in self._plays:
            angles[play.joint] += play.lag(float(q[play.joint]))
        return angles

    def _correction(self, effect: Effect, motion: Motion) -> float:
        assert effect.kind.encoder is not None
        return float(effect.kind.encoder.correction(motion, self._place(effect), effect.values)[-1])


class _LivePlay:
    """A play at a joint, whose first move says where in it the joint began."""

    def __init__(self, place: Place, width: float) -> None:
        self.joint = place.joint
        self._sign = float(np.sign(width))
        self._play = Play(abs(width))
        self._first: float | None = None
        self._moved = False

    def lag(self, reading: float) -> float:
        """Output minus input [rad, m] at the next reading."""
        if self._first is None:
            self._first = reading
        if not self._moved and reading != self._first:
            self._moved = True
            self._play.begin(self._first, reading - self._first)
        return self._sign * (self._play.follow(reading) - reading)
