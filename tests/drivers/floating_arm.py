"""Emulated arms moved by servos: pendulums driven by the currents that the driver commands."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Sequence
from operator import truediv

import numpy as np
from emulated_arm import HeardPort
from virtual_port import VirtualClock
from wire_faults import Planned

from bodyschema.drivers.dynamixel.config import BusConfig, DynamixelConfig, ServoConfig
from bodyschema.drivers.dynamixel.emulator.chain import Chain
from bodyschema.drivers.dynamixel.emulator.servo import CURRENT_MODE, Servo
from bodyschema.drivers.dynamixel.guard import GuardSettings
from bodyschema.drivers.dynamixel.joints import DynamixelJoints
from bodyschema.drivers.dynamixel.models import BY_NAME, TORQUE_AT_CURRENT
from bodyschema.drivers.dynamixel.powered_config import FloatingJoint, ZeroForceConfig
from bodyschema.drivers.dynamixel.zero_force import ZeroForce

MODEL = "XM430-W350"
CONSTANT = truediv(*TORQUE_AT_CURRENT[MODEL])
WEIGHT_N_M = 1.2  # of a pendulum that lies level
INERTIA, DAMPING, FRICTION_N_M = 0.03, 0.02, 0.01
STEP_S = 1e-3


class Pendulum:
    """One joint: level at 0, hanging at -90°. Its servo's shaft turns with it, or against it.

    Attributes:
        pushed: the torque of a hand [N·m].
    """

    def __init__(self, q: float, direction: int = 1, held_until: float = math.inf) -> None:
        self.servo: Servo | None = None
        self.direction, self.pushed, self.held_until = direction, 0.0, held_until
        self.q, self.v = q, 0.0
        self.times, self.path = [0.0], [q]

    def shaft(self, t: float) -> float:
        """Return the servo's angle [rad], also in the past."""
        self.move(t)
        place = bisect_right(self.times, t) - 1
        return self.direction * self.path[max(place, 0)]

    def move(self, t: float) -> None:
        """Let it swing until `t`."""
        if self.servo is None:
            self.times, self.path = [t], [self.q]
            return
        if self.times[-1] < t <= self.held_until:  # nothing moves
            self.v = 0.0
            self.times.append(t)
            self.path.append(self.q)
        while self.times[-1] < t:
            self._step(self.times[-1], min(STEP_S, t - self.times[-1]))

    def _step(self, now: float, dt: float) -> None:
        assert self.servo is not None
        torque = self.direction * CONSTANT * self.servo.motor_current(now)
        if now < self.held_until:
            self.v = 0.0
        else:
            force = torque + self.pushed - WEIGHT_N_M * math.cos(self.q) - DAMPING * self.v
            if self.v == 0.0 and abs(force) < FRICTION_N_M:
                force = 0.0
            elif self.v != 0.0:
                force -= math.copysign(FRICTION_N_M, self.v)
            before, self.v = self.v, self.v + force / INERTIA * dt
            if before * self.v < 0:
                self.v = 0.0
        self.q += self.v * dt
        self.times.append(now + dt)
        self.path.append(self.q)


def holding(q: np.ndarray) -> np.ndarray:
    """Return the torques that hold the pendulums [N·m]."""
    return WEIGHT_N_M * np.cos(q)


class FloatingArm:
    """A driver with zero-force over pendulums in virtual time."""

    def __init__(
        self,
        angles: Sequence[float] = (0.3, -0.4),
        *,
        torques=holding,
        directions: Sequence[int] | None = None,
        told_directions: Sequence[int] | None = None,
        current_limit_a: float = 2.0,
        mode: int = CURRENT_MODE,
        rate_hz: float = 100.0,
        **settings,
    ) -> None:
        self.clock = VirtualClock()
        directions = directions or (1,) * len(angles)
        held = self.clock.now() + 3600
        self.pendulums = [Pendulum(q, way, held) for q, way in zip(angles, directions, strict=True)]
        servos = []
        for id, pendulum in enumerate(self.pendulums, 1):
            servo = Servo(BY_NAME[MODEL], id, pendulum.shaft, return_delay_s=0.0, booted_s=id * 0.1234)
            servo["operating_mode"] = mode
            servo["goal_current"] = servo["current_limit"]  # as after the change of mode
            servos.append(servo)
        self.faults = Planned()
        self.chain = Chain(servos, self.faults)
        self.port = HeardPort(self.chain, self.clock)
        for pendulum, servo in zip(self.pendulums, servos, strict=True):
            pendulum.shaft(self.clock.now())
            pendulum.servo = servo
        self.names = tuple(f"joint{id}" for id in range(1, len(angles) + 1))
        self.table = ZeroForceConfig(
            joints={name: FloatingJoint(current_limit_a=current_limit_a) for name in self.names}, **settings
        )
        told = told_directions or directions
        entries = tuple(
            ServoConfig(name, id, MODEL, direction=1 if way > 0 else -1)
            for id, (name, way) in enumerate(zip(self.names, told, strict=True), 1)
        )
        self.config = DynamixelConfig({"arm": BusConfig("emulator")}, entries, zero_force=self.table, rate_hz=rate_hz)
        self.force = ZeroForce(self.config, self.table, self.names, torques, self.clock)
        self.joints = DynamixelJoints(
            self.config, self.names, self.clock, open_port=lambda *_: (self.port, 0.0), drives=[self.force]
        )

    def run(self, seconds: float) -> int:
        """Read for this time and return the number of readings."""
        end, readings = self.clock.now() + seconds, 0
        while self.clock.now() < end:
            readings += self.joints.read(0.02) is not None
        return readings

    def switch_on(self) -> str:
        """Ask for zero-force, and read until it answers."""
        return self.ask(on=True)

    def ask(self, *, on: bool) -> str:
        """Ask, and read until it answers."""
        answer = self.force.ask(on)
        while not answer.done():
            self.joints.read(0.02)
        return answer.result()

    def let_go(self) -> None:
        """Release the arm from the hand."""
        for pendulum in self.pendulums:
            pendulum.held_until = self.clock.now()

    def float(self) -> None:
        """Switch on, ramp in while a hand holds the arm, and then let go."""
        self.switch_on()
        self.run(GuardSettings.ramp_s + 0.1)
        self.let_go()

    @property
    def q(self) -> list[float]:
        """Positions of the pendulums [rad]."""
        return [pendulum.q for pendulum in self.pendulums]

    @property
    def torque(self) -> list[int]:
        """Torque register of each servo."""
        return [servo["torque"] for servo in self.chain.servos]

    def currents(self) -> list[float]:
        """Return the currents that the servos regulate now [A]."""
        return [servo.motor_current(self.clock.now()) for servo in self.chain.servos]
