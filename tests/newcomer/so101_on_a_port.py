"""An SO-101 in virtual time, read by its driver byte by byte, and a camera that sees a marker on its hand."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Self

import numpy as np
from virtual_port import VirtualClock, VirtualPort

from bodyschema.daemon.config import Config
from bodyschema.drivers.feetech.emulator.arm import Chain
from bodyschema.drivers.feetech.emulator.servo import Servo
from bodyschema.drivers.feetech.joints import FeetechJoints
from bodyschema.drivers.feetech.models import BY_NAME
from bodyschema.interfaces.records import FloatArray
from bodyschema.recordings.recording import Recording
from bodyschema.robot.description import RobotDescription
from bodyschema.robot.lerobot import RAD_PER_TICK, Calibrations
from kbmaps import ChainParameters, ChainTolerances

SPEED_RAD_S = math.radians(30.0)
EVERY_S = 0.2
NOISE_M = 5e-4


class So101:
    """An arm whose middle was set by eye, so that its true angles differ by `offsets_deg` from its readings.

    Its links are built to 0.1° and 0.3 mm, its camera stands anywhere, its marker is 20 mm off nominal.
    """

    def __init__(self, robot: RobotDescription, motors: Calibrations, offsets_deg: Sequence[float], seed: int) -> None:
        self.rng = np.random.default_rng(seed)
        self._offsets = np.radians(offsets_deg)
        self._parameters = ChainParameters(robot.chain)
        made = ChainTolerances(0.002, 0.0003, tool=0.02, base_rotation=1.0, base_translation=0.5)
        self._built = self._parameters.standard_deviations(made) * self.rng.normal(size=self._parameters.size)
        self._factory = {name: motors[name] for name in robot.joints}
        self._goals = self.rng.uniform(0.8 * robot.lower, 0.8 * robot.upper, (1000, len(robot.joints)))
        self._ways = np.abs(np.diff(self._goals, axis=0)).max(axis=1) / SPEED_RAD_S
        self._ends = np.cumsum(self._ways)
        self.servos = [
            Servo(BY_NAME["STS3215"], motor.id, lambda t, k=k: self._shaft(k, t), return_delay_s=0)
            for k, motor in enumerate(self._factory.values())
        ]
        self.give(motors)

    def give(self, motors: Calibrations) -> Self:
        """Write the homing offsets to the servos, as LeRobot does when it starts."""
        for name, servo in zip(self._factory, self.servos, strict=True):
            servo["homing_offset"] = motors[name].homing_offset
        return self

    def record(self, robot: Config, rows: int) -> Recording:
        """Guide the arm for `rows` readings; return joints as its driver reads them and positions as a camera does."""
        config, clock = robot.tables.drivers.feetech, VirtualClock()
        assert config is not None
        port = VirtualPort(Chain(self.servos), clock)
        q, t = np.empty((rows, len(self._offsets))), np.empty(rows)
        names = robot.robot.joints
        with FeetechJoints(config, names, clock, open_port=lambda *_: (port, 0.0)) as joints:
            for row in range(rows):
                clock.wait_until(clock.now() + EVERY_S)
                reading = joints.read(1.0)
                assert reading is not None
                q[row], t[row] = reading.q, reading.t
        x = self._parameters.positions(self._built, np.array([self._pose(at) for at in t]))
        return Recording(joints=names, q=q, x=x + NOISE_M * self.rng.normal(size=x.shape), t=t)

    def _shaft(self, joint: int, t: float) -> float:
        """Return the shaft's angle from its middle [rad]."""
        motor = list(self._factory.values())[joint]
        return (motor.homing_offset + motor.middle - 2048) * RAD_PER_TICK + self._pose(t)[joint] - self._offsets[joint]

    def _pose(self, t: float) -> FloatArray:
        """Return the joints' true angles: straight from goal to goal, as fast as the slowest joint of a hand is."""
        k = int(np.searchsorted(self._ends, t))
        share = 1.0 - (self._ends[k] - t) / self._ways[k]
        return self._goals[k] + share * (self._goals[k + 1] - self._goals[k])
