"""Zero-force with the weight stated in the URDF, on an arm that falls in an independent simulator."""

from __future__ import annotations

import math
from bisect import bisect_right
from operator import truediv
from pathlib import Path

import numpy as np
import pytest
from test_zero_force_process import write_robot
from virtual_port import VirtualClock, VirtualPort

from bodyschema.daemon.config import Config
from bodyschema.daemon.wiring.wiring import open_drives
from bodyschema.drivers.dynamixel.emulator.chain import Chain
from bodyschema.drivers.dynamixel.emulator.servo import CURRENT_MODE, Servo
from bodyschema.drivers.dynamixel.joints import DynamixelJoints
from bodyschema.drivers.dynamixel.models import BY_NAME, TORQUE_AT_CURRENT

pybullet = pytest.importorskip("pybullet")

STEP_S = 1e-3
FRICTION_N_M = 0.02  # of each joint; a gear has more
DRIFT_RAD = math.radians(0.5)
BEGIN = (0.3, -0.5)


class BulletArm:
    """The arm of a URDF in pybullet, each joint driven by its servo's current times its torque constant."""

    def __init__(self, urdf: Path) -> None:
        self.client = pybullet.connect(pybullet.DIRECT)
        pybullet.setGravity(0, 0, -9.80665, physicsClientId=self.client)
        pybullet.setTimeStep(STEP_S, physicsClientId=self.client)
        flags = pybullet.URDF_USE_INERTIA_FROM_FILE
        self.body = pybullet.loadURDF(str(urdf), useFixedBase=True, flags=flags, physicsClientId=self.client)
        for joint, q in enumerate(BEGIN):
            pybullet.resetJointState(self.body, joint, q, physicsClientId=self.client)
            pybullet.setJointMotorControl2(
                self.body, joint, pybullet.VELOCITY_CONTROL, force=FRICTION_N_M, physicsClientId=self.client
            )
        self.servos: list[Servo] = []
        self.held = True
        self.times, self.path = [0.0], [np.array(BEGIN)]

    def angle(self, joint: int, t: float) -> float:
        """Return the angle of a joint at `t` [rad], also in the past."""
        while self.servos and self.times[-1] + STEP_S <= t:
            self._step(self.times[-1])
        return float(self.path[max(bisect_right(self.times, t) - 1, 0)][joint])

    def _step(self, now: float) -> None:
        q = self.path[-1]
        if not self.held:
            constant = truediv(*TORQUE_AT_CURRENT["XM430-W350"])
            for joint, servo in enumerate(self.servos):
                pybullet.setJointMotorControl2(
                    self.body,
                    joint,
                    pybullet.TORQUE_CONTROL,
                    force=constant * servo.motor_current(now),
                    physicsClientId=self.client,
                )
            pybullet.stepSimulation(physicsClientId=self.client)
            q = np.array([pybullet.getJointState(self.body, j, physicsClientId=self.client)[0] for j in range(len(q))])
        self.times.append(now + STEP_S)
        self.path.append(q)


def moved(tmp_path: Path, *, on: bool, seconds: float) -> np.ndarray:
    """Return the distance each joint moves when the arm is released, with zero-force or without [rad] (2,)."""
    config = Config.load(write_robot(tmp_path))
    servos_config, clock = config.tables.drivers.dynamixel, VirtualClock()
    assert servos_config is not None
    arm = BulletArm(tmp_path / "arm.urdf")
    arm.times = [clock.now()]
    servos = [
        Servo(BY_NAME["XM430-W350"], joint + 1, lambda t, joint=joint: arm.angle(joint, t), return_delay_s=0.0)
        for joint in range(2)
    ]
    for servo in servos:
        servo["operating_mode"], servo["goal_current"] = CURRENT_MODE, servo["current_limit"]
    arm.servos = servos
    force, *_ = drives = open_drives(config, servos_config, clock)
    port = VirtualPort(Chain(servos), clock)
    joints = DynamixelJoints(servos_config, config.robot.joints, clock, open_port=lambda *_: (port, 0.0), drives=drives)
    with joints:
        answer = force.ask(on)
        end = clock.now() + 0.5
        while clock.now() < end or not answer.done():
            joints.read(0.02)
        arm.held, begin, end = False, arm.path[-1], clock.now() + seconds
        while clock.now() < end:
            joints.read(0.02)
        assert force.state == ("on" if on else "off")
        return arm.path[-1] - begin


@pytest.mark.soak
def test_the_arm_floats_where_it_is_left(tmp_path) -> None:
    assert np.abs(moved(tmp_path, on=True, seconds=2.0)).max() < DRIFT_RAD


def test_the_arm_falls_without_zero_force(tmp_path) -> None:
    assert np.abs(moved(tmp_path, on=False, seconds=0.5)).max() > math.radians(30)
