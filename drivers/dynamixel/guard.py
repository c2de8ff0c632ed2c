"""Decide when torque must go off, and limit currents. Independent of any bus: numbers in, numbers or `Drop` out."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

from bodyschema.interfaces.records import FloatArray, frozen_array


class GuardSettings:
    shortest_base_s: float = 0.02  # shortest interval for a speed from positions: one tick is 4°/s at most
    current_slack, current_slack_a = 0.15, 0.05  # allowance for the servo's own current regulation
    refusals: int = 3  # consecutive goals that a servo ignored
    doubtful_cycles: int = 10  # consecutive checks without a reading
    look_every_s: float = 0.05  # period of reading one servo's torque, health, watchdog and goal
    ramp_s: float = 1.0  # duration of the ramp of the currents
    saturated_s: float = 1.0  # time at its current limit after which a joint is reported to sink
    overcurrent_s: float = 0.5  # time that a current exceeds its limit


class Drop(Exception):
    """Demand to switch torque off at once; the text says why and what to do."""


@dataclass(frozen=True, slots=True)
class GuardLimits:
    """Limits that must not be exceeded."""

    joints: tuple[str, ...]  # names, in the order of all arrays (n,)
    heartbeat_s: float  # longest time between two checks
    max_speed: FloatArray  # of each joint [rad/s]
    current_limit: FloatArray  # of each joint [A]; infinite where it is not monitored
    max_temperature_c: float  # a servo at this or above is too hot


@dataclass(frozen=True, slots=True)
class Motion:
    """One reading of the joints with torque, arrays (n,)."""

    t: float  # of the reading [s]
    q: FloatArray  # angles [rad]
    velocity: FloatArray  # as reported by the servos [rad/s]
    current: FloatArray  # measured [A], 0 where it is not
    alert: Sequence[bool]  # True for a servo that reports a fault


@dataclass(frozen=True, slots=True)
class ServoState:
    """Part of one servo's control table while it has torque."""

    has_torque: bool  # its torque is on
    trouble: str  # its hardware error, in words; may be empty
    watchdog: int  # Bus Watchdog: negative after it has fired, 0 while it is not armed
    took_goal: bool  # its goal is the one that was sent last
    temperature_c: float  # measured [°C]


class Guard:
    """Monitor of joints with torque. Before `begin`, and after any violation, every check raises `Drop`.

    A violation is permanent: only a new `begin` clears it.
    """

    def __init__(self, limits: GuardLimits) -> None:
        self._limits = limits
        self._why: str | None = "it was not begun"
        self._checked_s = -math.inf
        self._rejected_cycles = 0
        self._refusals: dict[str, int] = {}
        self._track: deque[tuple[float, FloatArray]] = deque()
        self._over_since = [math.inf] * len(limits.joints)

    def begin(self, now: float) -> None:
        """Start monitoring on a user's request at `now` [s]."""
        self.__init__(self._limits)
        self._why, self._checked_s = None, now

    def check(self, now: float, motion: Motion | None) -> None:
        """Check one cycle at `now` [s]; `motion` is None when the reading was rejected.

        Raises:
            Drop: it violates a limit.
        """
        with self._permanent():
            self._check(now, motion)

    def check_servo(self, joint: str, state: ServoState) -> None:
        """Check the reported state of one servo, at intervals; raise Drop if it violates a limit."""
        with self._permanent():
            self._check_servo(joint, state)

    @contextmanager
    def _permanent(self) -> Iterator[None]:
        """Raise Drop after any violation, and make one that is found permanent."""
        if self._why is not None:
            raise Drop(self._why)
        try:
            yield
        except Drop as drop:
            self._why = str(drop)
            raise

    def _check(self, now: float, motion: Motion | None) -> None:
        late_s, self._checked_s = now - self._checked_s, now
        if not 0 <= late_s <= self._limits.heartbeat_s:
            raise Drop(
                f"this was held up for {1e3 * late_s:.0f} ms (heartbeat {1e3 * self._limits.heartbeat_s:.0f} ms). "
                "Run less beside it, or give a longer heartbeat_ms"
            )
        if motion is None:
            self._rejected_cycles += 1
            if self._rejected_cycles >= GuardSettings.doubtful_cycles:
                raise Drop(
                    f"{self._rejected_cycles} readings in a row could not be believed. "
                    "Look at cable and supply: `bodyschema doctor`"
                )
            return
        self._rejected_cycles = 0
        self._check_motion(motion)

    def _check_motion(self, motion: Motion) -> None:
        for joint, alert in zip(self._limits.joints, motion.alert, strict=True):
            if alert:
                raise Drop(f"the servo of joint {joint!r} reports a fault. `bodyschema doctor` says which")
        numbers = np.stack([motion.q, motion.velocity, motion.current])
        if not (np.isfinite(numbers).all() and math.isfinite(motion.t)):
            raise Drop("a reading is not finite. Report this: it should have been refused before")
        self._check_speed("by its servo", np.abs(motion.velocity))
        self._track.append((motion.t, frozen_array(motion.q)))
        while len(self._track) > 1 and motion.t - self._track[1][0] >= GuardSettings.shortest_base_s:
            self._track.popleft()
        base_s = motion.t - self._track[0][0]
        if base_s >= GuardSettings.shortest_base_s:
            self._check_speed("by its positions", np.abs(motion.q - self._track[0][1]) / base_s)
        self._check_currents(motion.t, np.abs(motion.current))

    def _check_speed(self, how: str, speed: FloatArray) -> None:
        worst = int(np.argmax(speed / self._limits.max_speed))
        if speed[worst] > self._limits.max_speed[worst]:
            fast, most = math.degrees(speed[worst]), math.degrees(self._limits.max_speed[worst])
            raise Drop(
                f"joint {self._limits.joints[worst]!r} turned at {fast:.0f}°/s ({how}; {most:.0f}°/s are allowed). "
                "If no one moved it so fast: look at direction, torque_constant and the URDF's masses"
            )

    def _check_currents(self, t: float, current: FloatArray) -> None:
        allowed = (1 + GuardSettings.current_slack) * self._limits.current_limit + GuardSettings.current_slack_a
        for place, joint in enumerate(self._limits.joints):
            if current[place] <= allowed[place]:
                self._over_since[place] = math.inf
                continue
            self._over_since[place] = min(self._over_since[place], t)
            if t - self._over_since[place] >= GuardSettings.overcurrent_s:
                raise Drop(
                    f"joint {joint!r} drew {current[place]:.2f} A for {t - self._over_since[place]:.1f} s "
                    f"({self._limits.current_limit[place]:.2f} A are allowed). Free the joint"
                )

    def _check_servo(self, joint: str, state: ServoState) -> None:
        if state.trouble:
            raise Drop(f"joint {joint!r}: {state.trouble}")
        if state.watchdog < 0:
            raise Drop(f"joint {joint!r}: its servo heard nothing for too long and stopped. Look at the cable")
        if not state.has_torque or state.watchdog == 0:
            raise Drop(f"joint {joint!r}: its servo lost torque or its watchdog. Look at supply and cable")
        # Written so that NaN counts as too hot.
        if not state.temperature_c < self._limits.max_temperature_c:
            raise Drop(f"joint {joint!r}: its servo is at {state.temperature_c:.0f} °C. Let it cool down")
        self._refusals[joint] = 0 if state.took_goal else self._refusals.get(joint, 0) + 1
        if self._refusals[joint] >= GuardSettings.refusals:
            raise Drop(f"joint {joint!r}: its servo does not take its goal. Look at the cable: `bodyschema doctor`")


class Currents:
    """Currents that carry the arm: within their limits, ramped up from zero."""

    def __init__(
        self, joints: Sequence[str], torque_constant: FloatArray, current_limit: FloatArray, share: float
    ) -> None:
        """Store arrays of shape (n,).

        Args:
            torque_constant: of each joint [N·m/A].
            current_limit: of each joint [A].
            share: of the torque that is applied, up to 1.
        """
        self._joints = tuple(joints)
        self._constant, self._limit = torque_constant, current_limit
        self._share = share
        self._begin_s = math.inf
        self.saturated: tuple[str, ...] = ()

    def begin(self, now: float) -> None:
        """Start the ramp at `now` [s]."""
        self._begin_s, self.saturated = now, ()

    def share(self, now: float) -> float:
        """Return the share of the torque that is applied at `now` [s]."""
        return self._share * min(max((now - self._begin_s) / GuardSettings.ramp_s, 0.0), 1.0)

    def at(self, now: float, torques: FloatArray) -> FloatArray:
        """Return the currents [A] (n,) for the torques that hold the arm [N·m] (n,).

        Raises:
            Drop: the torques are not finite.
        """
        if torques.shape != self._limit.shape or not np.isfinite(torques).all():
            raise Drop("the model gives no torque for where the arm is. Look at the URDF's masses and joint limits")
        currents = self.share(now) * torques / self._constant
        self.saturated = tuple(
            joint for joint, over in zip(self._joints, np.abs(currents) > self._limit, strict=True) if over
        )
        return np.clip(currents, -self._limit, self._limit)
