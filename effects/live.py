"""Apply the first stage reading by reading while the robot moves, equal to `Simulation.run` on a whole motion."""

from __future__ import annotations

from collections import deque

import numpy as np

from bodyschema.interfaces.records import FloatArray

from .effect import Effect
from .encoder import Backlash, Bristle, Hysteresis, Place, Play, Settling
from .motion import Motion
from .simulation import Simulation


class LiveEncoders:
    """True joint angles from encoder readings, in the order of the readings.

    Every reading drives a backlash. It starts on the side of the first change; before any change, it is centred.

    Args:
        row_readings: number of readings between rows, for effects that depend on the row before.
    """

    def __init__(self, simulation: Simulation, row_readings: int = 1) -> None:
        encoder = [effect for effect in simulation.all_effects if effect.kind.encoder is not None]
        plays = [effect for effect in encoder if isinstance(effect.kind.encoder, Backlash)]
        settling = [effect for effect in encoder if isinstance(effect.kind.encoder, Settling)]
        lags = [effect for effect in encoder if isinstance(effect.kind.encoder, Hysteresis)]
        self._place = simulation.place
        self._plays = [_LivePlay(simulation.place(effect), float(effect.values[0])) for effect in plays]
        self._settling = [_LiveSettling(simulation.place(effect), effect, row_readings) for effect in settling]
        self._lags = [_LiveHysteresis(simulation.place(effect), effect) for effect in lags]
        self._others = [effect for effect in encoder if effect not in (*plays, *settling, *lags)]

    def true_angles(self, q: FloatArray, t: float, move: FloatArray) -> FloatArray:
        """Return true joint angles (d,) [rad, m] at the readings q (d,) and the time t [s].

        Args:
            move: the move (d,) since the row before, for joints that have not settled.
        """
        angles = q.copy()
        motion = Motion.at(q, t)
        for effect in self._others:
            angles[self._place(effect).joint] += self._correction(effect, motion)
        for settling in self._settling:
            angles[settling.joint] -= settling.missing(float(move[settling.joint]))
        for play in self._plays:
            angles[play.joint] += play.lag(float(q[play.joint]))
        for lag in self._lags:
            angles[lag.joint] -= lag.behind(float(q[lag.joint]))
        return angles

    def _correction(self, effect: Effect, motion: Motion) -> float:
        assert effect.kind.encoder is not None
        return float(effect.kind.encoder.correction(motion, self._place(effect), effect.values)[0])


class _LiveSettling:
    """Remaining lag of a joint that is read before it has settled."""

    def __init__(self, place: Place, effect: Effect, row_readings: int) -> None:
        self.joint = place.joint
        self._fraction, self._memory = effect.value("fraction"), effect.value("memory")
        self._missing: deque[float] = deque([0.0] * row_readings, maxlen=row_readings)

    def missing(self, move: float) -> float:
        """Return the remaining lag [rad, m] after the move since the row before."""
        self._missing.append(self._fraction * move + self._memory * self._missing[0])
        return self._missing[-1]


class _LivePlay:
    """A backlash at a joint; the first move determines its initial side."""

    def __init__(self, place: Place, width: float) -> None:
        self.joint = place.joint
        self._sign = float(np.sign(width))
        self._play = Play(abs(width))
        self._first: float | None = None
        self._moved = False

    def lag(self, reading: float) -> float:
        """Return output minus input [rad, m] at the next reading."""
        if self._first is None:
            self._first = reading
        if not self._moved and reading != self._first:
            self._moved = True
            self._play.begin(self._first, reading - self._first)
        return self._sign * (self._play.follow(reading) - reading)


class _LiveHysteresis:
    """Friction behind an elastic drive; the first move determines its initial strain."""

    def __init__(self, place: Place, effect: Effect) -> None:
        self.joint = place.joint
        self._lag, length = effect.values
        self._bristle = Bristle(float(length))
        self._first: float | None = None
        self._moved = False

    def behind(self, reading: float) -> float:
        """Return the lag of the joint [rad, m] at the next reading."""
        if self._first is None:
            self._first = reading
        if not self._moved and reading != self._first:
            self._moved = True
            self._bristle.begin(self._first, reading - self._first)
        return float(self._lag) * self._bristle.follow(reading)
