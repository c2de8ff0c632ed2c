"""Gaze: turn the head's servos to a target, slowly and within limits."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from bodyschema.drivers.servos.channel import Sample
from bodyschema.drivers.servos.servo import IdentifiedServo
from bodyschema.interfaces.errors import RequestError
from bodyschema.interfaces.protocols import Clock
from bodyschema.interfaces.records import FloatArray, frozen_array

from .guard import Drop, Guard, GuardLimits
from .models import MODES
from .powered import PoweredJoints
from .powered_config import GazeConfig


class _Settings:
    stale_s = 0.5  # without a newer target for this long, the head stands still
    blocked_s, blocked_deg = 1.0, 15.0  # torque goes off when the head stays this far from its command for this long
    speed_margin: float = 3.0  # a head that moves this many times faster than commanded is out of control
    longest_step_s: float = 0.05  # a longer pause between two cycles moves the head no farther than this one


class Gaze(PoweredJoints):
    """Joints that turn the head towards the latest `aim`; see `PoweredJoints`.

    Attributes:
        lower, upper: limits of the head's joints [rad] (g,).
    """

    name, goal = "gaze", "goal"
    mode, mode_name = MODES["position"], "position control"

    def __init__(
        self, gaze: GazeConfig, joints: Sequence[str], limits: Sequence[tuple[float, float]], clock: Clock
    ) -> None:
        """Start with torque off.

        Args:
            joints: all, in the order of q.
            limits: of all joints [rad]; the narrower of these and the table's apply.
        """
        self._head = [joint for joint in joints if joint in gaze.joints]
        count, speed = len(self._head), math.radians(gaze.max_speed_deg_s)
        guard = GuardLimits(
            joints=tuple(self._head),
            heartbeat_s=gaze.heartbeat_s,
            max_speed=np.full(count, _Settings.speed_margin * speed),
            current_limit=np.full(count, math.inf),
            max_temperature_c=gaze.max_temperature_c,
        )
        super().__init__(gaze, self._head, Guard(guard), clock)
        self._speed = speed
        narrow = [gaze.limits_deg.get(joint, (-math.inf, math.inf)) for joint in self._head]
        wide = [limits[list(joints).index(joint)] for joint in self._head]
        self.lower = frozen_array([max(w[0], math.radians(n[0])) for w, n in zip(wide, narrow, strict=True)])
        self.upper = frozen_array([min(w[1], math.radians(n[1])) for w, n in zip(wide, narrow, strict=True)])
        self._ranges: dict[str, tuple[int, int]] = {}
        self._aim: tuple[float, FloatArray] | None = None
        self._pose: tuple[float, FloatArray] | None = None
        self._command: FloatArray | None = None
        self._commanded_s = self._astray_s = math.inf

    @property
    def head(self) -> tuple[str, ...]:
        """Names of the head's joints, in the order of the angles that `aim` takes."""
        return tuple(self._head)

    @property
    def pose(self) -> tuple[float, FloatArray] | None:
        """Time [s] and angles of all joints [rad] (d,) of the newest reading while on, else None; from any thread."""
        return self._pose if self.state == "on" else None

    def aim(self, t: float, angles: FloatArray) -> None:
        """Set the target angles (g,) [rad] of the head's joints at `t` [s]. May be called from any thread."""
        self._aim = (t, frozen_array(angles))

    def _prepare(self, servo: IdentifiedServo) -> int:
        """Return the present position as the goal, so that the joint does not move when its torque goes on."""
        if self._read(servo, "homing_offset") != 0:
            raise RequestError(
                f"joint {servo.joint!r} (ID {servo.id}) has a Homing Offset: it may turn when its watchdog stops it. "
                "Give zero_ticks in robot.toml, and type: "
                f"`bodyschema servos homing_offset=0 --joint {servo.joint}`"
            )
        # With torque on, the position is within one turn (e-Manual, Present Position).
        turn, middle = servo.model.ticks_per_turn or 0, servo.model.zero_ticks
        position = self._read(servo, "position")
        position -= turn * math.floor((position - (middle - turn // 2)) / turn)
        lowest, highest = self._read(servo, "min_position"), self._read(servo, "max_position")
        if not lowest <= position <= highest:
            raise RequestError(
                f"joint {servo.joint!r} (ID {servo.id}) stands at {position} ticks, its servo allows {lowest} to "
                f"{highest}. Turn the head back by hand"
            )
        self._ranges[servo.joint] = (lowest, highest)
        return position

    def _begin(self, now: float) -> None:
        self._aim = self._pose = self._command = None
        self._commanded_s, self._astray_s = now, math.inf

    def _goals(self, now: float, q: FloatArray, samples: Mapping[str, Sample | None]) -> list[int]:
        self._pose = (now, q)
        here = q[self._places]
        if self._command is None:
            self._command = here
        dt = min(now - self._commanded_s, _Settings.longest_step_s)
        self._commanded_s = now
        self._command = command = self._next(now, self._command, dt)
        self._check_astray(now, np.abs(here - command))
        return [self._ticks(*each, samples) for each in zip(self._servos, command - here, strict=True)]

    def _next(self, now: float, command: FloatArray, dt: float) -> FloatArray:
        """Return the next command: towards a fresh target at the allowed speed, else unchanged."""
        if self._aim is None:
            return command
        t, angles = self._aim
        if now - t > _Settings.stale_s or angles.shape != command.shape or not np.isfinite(angles).all():
            return command
        aim = np.clip(angles, self.lower, self.upper)
        return command + np.clip(aim - command, -self._speed * dt, self._speed * dt)

    def _check_astray(self, now: float, off: FloatArray) -> None:
        worst = int(np.argmax(off))
        if off[worst] <= math.radians(_Settings.blocked_deg):
            self._astray_s = math.inf
            return
        self._astray_s = min(self._astray_s, now)
        if now - self._astray_s > _Settings.blocked_s:
            raise Drop(
                f"joint {self._head[worst]!r} stays {math.degrees(off[worst]):.0f}° from where it should be. Free it"
            )

    def _ticks(self, servo: IdentifiedServo, ahead: float, samples: Mapping[str, Sample | None]) -> int:
        """Return the goal register of a command `ahead` of the joint [rad], relative to the servo's position."""
        sample = samples[servo.joint]
        if sample is None:
            raise Drop("no reading")
        goal = sample.ticks + round(servo.direction * ahead / servo.model.rad_per_tick)
        lowest, highest = self._ranges[servo.joint]
        return min(max(goal, lowest), highest)

    def _on_message(self) -> str:
        return f"gaze is on: {', '.join(self._head)} turn to the hand. Keep fingers off the head"
