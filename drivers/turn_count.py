"""Determine the turn of each multi-turn joint from its last known position."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from typing import Protocol

from bodyschema.interfaces.errors import SourceLost

from .speed_gate import nearest_turn

log = logging.getLogger(__name__)

LOST_AFTER_S = 0.25  # without a reading; no joint makes half a turn unnoticed in this time


class _Settings:
    max_moved_deg: int = 30  # while nothing was read; beyond it the nearest turn may be another one
    look_again_s: float = 1.0  # period of checking if a joint was turned back


class Sensor(Protocol):
    """One joint's sensor."""

    @property
    def joint(self) -> str:
        """The joint's name."""
        ...

    @property
    def label(self) -> str:
        """Name of the sensor on its device."""
        ...

    @property
    def ticks_per_turn(self) -> int | None:
        """Ticks after which the reading repeats; None for a sensor that does not wrap."""

    def angle(self, ticks: int) -> float:
        """Return the joint angle [rad] at a position with its turns [ticks]."""
        ...

    def ticks(self, angle: float) -> float:
        """Return the position [ticks] at a joint angle [rad]."""
        ...


class TurnCount:
    """Positions including whole turns [ticks], tracked from reading to reading.

    Attributes:
        pose: last joint angles [rad]; None before the first reading.
        lost: a joint that has moved meanwhile, so that the user must confirm its turn.
    """

    def __init__(self, limits: Sequence[tuple[float, float]], last_pose: Sequence[float] | None) -> None:
        """Start without a reading.

        Args:
            limits: limits of each joint [rad]; a range below one turn determines the turn.
            last_pose: joint angles of the last session [rad], shape (d,).
        """
        self._limits = list(limits)
        self.pose = None if last_pose is None else [float(q) for q in last_pose]
        self.counts: list[int] = []
        self._sensors: list[Sensor] = []
        self._is_accepted = False
        self.lost: str | None = None

    def accept(self) -> None:
        """Accept the turns nearest to the last pose as correct. May be called from any thread."""
        self._is_accepted = self.lost is not None

    def begin(self, sensors: Sequence[Sensor], raw: Sequence[int]) -> None:
        """Determine the turn of each joint from its limits, otherwise from the last pose."""
        self._sensors = list(sensors)
        self.counts = [self._nearest(place, ticks) for place, ticks in enumerate(raw)]

    def unwrapped(self, raw: Sequence[int]) -> list[int]:
        """Return `raw` plus the whole turns that bring it nearest to the last kept positions."""
        together = zip(self._sensors, raw, self.counts, strict=True)
        return [nearest_turn(ticks, count, sensor.ticks_per_turn) for sensor, ticks, count in together]

    def keep(self, counts: list[int]) -> list[float]:
        """Store positions and return the joint angles [rad]."""
        self.counts = counts
        self.pose = [sensor.angle(count) for sensor, count in zip(self._sensors, counts, strict=True)]
        return self.pose

    def check(self, raw: Sequence[int]) -> None:
        """Raise SourceLost if a multi-turn joint has moved meanwhile: its turn is unknown then."""
        if self.pose is None:
            return
        for place, (sensor, count) in enumerate(zip(self._sensors, self.counts, strict=True)):
            if self._is_within_a_turn(place):
                continue
            was, now = self.pose[place], sensor.angle(count)
            if abs(now - was) > math.radians(_Settings.max_moved_deg) and self._is_accepted:
                log.warning("joint %r: at %.0f°, as a command stated", sensor.joint, math.degrees(now))
            elif abs(now - was) > math.radians(_Settings.max_moved_deg):
                self.lost = sensor.joint
                raise SourceLost(
                    f"joint {sensor.joint!r} ({sensor.label}) was at {math.degrees(was):.0f}° and is now at "
                    f"{math.degrees(now):.0f}°, or whole turns from there: its turn count is lost. "
                    f"Turn it back to within {_Settings.max_moved_deg}° of where it was. If it really is at "
                    f"{math.degrees(now):.0f}°: `bodyschema command accept_turns` while the sampler runs",
                    retry_s=_Settings.look_again_s,
                )
            if count != raw[place]:
                turns = round((count - raw[place]) / (sensor.ticks_per_turn or 1))
                log.info("joint %r: %+d turns are added to what its sensor counts", sensor.joint, turns)
        self.lost, self._is_accepted = None, False

    def _is_within_a_turn(self, place: int) -> bool:
        lower, upper = self._limits[place]
        return upper - lower < 2 * math.pi

    def _nearest(self, place: int, ticks: int) -> int:
        sensor, (lower, upper) = self._sensors[place], self._limits[place]
        if self._is_within_a_turn(place):
            return nearest_turn(ticks, sensor.ticks((lower + upper) / 2), sensor.ticks_per_turn)
        if self.pose is not None:
            return nearest_turn(ticks, sensor.ticks(self.pose[place]), sensor.ticks_per_turn)
        return ticks
