"""The demonstration's upper body on the emulator: its arm moves along a path, its head follows its servos."""

from __future__ import annotations

import math

import numpy as np
from emulated_arm import HeardPort
from virtual_port import VirtualClock
from wire_faults import Planned

from bodyschema.daemon.sampler.gaze_loop import GazeLoop, HandModel
from bodyschema.daemon.wiring.wiring import demonstration_model
from bodyschema.drivers.dynamixel.config import BusConfig, DynamixelConfig, ServoConfig
from bodyschema.drivers.dynamixel.emulator.arm import DrivenShaft
from bodyschema.drivers.dynamixel.emulator.chain import Chain
from bodyschema.drivers.dynamixel.emulator.servo import Servo
from bodyschema.drivers.dynamixel.gaze import Gaze
from bodyschema.drivers.dynamixel.joints import DynamixelJoints
from bodyschema.drivers.dynamixel.models import BY_NAME
from bodyschema.drivers.dynamixel.powered_config import GazeConfig
from bodyschema.interfaces.errors import BusError
from bodyschema.robot.description import RobotDescription
from bodyschema.robot.pointing import Pointing
from kbmaps import RigidChain

MODEL = "XM430-W350"
HEAD = ("neck_yaw", "neck_pitch")
MIDDLE = np.radians([0.0, 20.0, 35.0, -15.0, 0.0, 80.0, 0.0])
SWING = np.radians([0.0, 0.0, 30.0, 20.0, 30.0, 30.0, 20.0])
PACE = np.array([0.0, 0.0, 0.5, 0.7, 0.4, 0.6, 0.9])
HEAD_SPEED = math.radians(80)
LOOK_S = 0.04


def nobody(payload: bytes) -> bytes:
    """Return None: no learner answers."""
    raise BusError("nobody answers")


class GazingRobot:
    """A driver with gaze on the emulator, in virtual time; `truth` is the true arm."""

    def __init__(self, predict=nobody, truth: RigidChain | None = None, rate_hz: float = 100.0, **settings) -> None:
        self.clock = VirtualClock()
        self.robot = robot = RobotDescription.load(demonstration_model())
        assert robot.calibration is not None
        self.truth = robot.chain if truth is None else truth
        pointing = Pointing(robot.calibration, (0, 1), robot.lower[:2], robot.upper[:2])
        start = MIDDLE[None].copy()
        for _ in range(20):
            start[:, :2] = pointing.clipped(start[:, :2] + pointing.step(start, robot.chain.positions))
        self.heads = [DrivenShaft(float(q), HEAD_SPEED) for q in start[0, :2]]
        begin = self.clock.now()
        arm = [
            lambda t, k=k: float(MIDDLE[k] + SWING[k] * math.sin(PACE[k] * max(t - begin, 0.0))) for k in range(2, 7)
        ]
        servos = [
            Servo(BY_NAME[MODEL], id, shaft, return_delay_s=0.0, booted_s=id * 0.1234)
            for id, shaft in enumerate([*self.heads, *arm], 1)
        ]
        self.faults = Planned()
        self.chain = Chain(servos, self.faults)
        for head, servo in zip(self.heads, servos, strict=False):
            head.servo = servo
        self.port = HeardPort(self.chain, self.clock)
        self.table = GazeConfig(joints=HEAD, **{"max_speed_deg_s": 60.0, **settings})
        entries = tuple(ServoConfig(joint, id, MODEL) for id, joint in enumerate(robot.joints, 1))
        self.config = DynamixelConfig({"arm": BusConfig("emulator")}, entries, gaze=self.table, rate_hz=rate_hz)
        limits = list(zip(robot.lower.tolist(), robot.upper.tolist(), strict=True))
        self.gaze = Gaze(self.table, robot.joints, limits, self.clock)
        self.model = HandModel(robot, predict, self.clock)
        self.loop = GazeLoop(robot, self.gaze, self.model)
        self.joints = DynamixelJoints(
            self.config,
            robot.joints,
            self.clock,
            limits=limits,
            open_port=lambda *_: (self.port, 0.0),
            drives=[self.gaze],
        )

    def switch_on(self) -> str:
        """Ask for gaze, and read until it answers."""
        answer = self.gaze.ask(True)
        while not answer.done():
            self.joints.read(0.02)
        return answer.result()

    def run(self, seconds: float, *, looking: bool = True) -> np.ndarray:
        """Read for this time and return the hand's position in the left image at each reading [px] (n, 2)."""
        end, next_look, seen = self.clock.now() + seconds, 0.0, []
        while self.clock.now() < end:
            reading = self.joints.read(0.02)
            if reading is None:
                continue
            seen.append(self.pixel())
            if looking and self.clock.now() >= next_look:
                next_look = self.clock.now() + LOOK_S
                self.loop.look()
        return np.array(seen)

    def q(self) -> np.ndarray:
        """Return the positions of all joints [rad] (d,)."""
        return np.array([servo.angle(self.clock.now()) for servo in self.chain.servos])

    def pixel(self) -> np.ndarray:
        """Return the hand's position in the left image [px] (2,)."""
        calibration = self.robot.calibration
        assert calibration is not None
        x, y, z = self.truth.positions(self.q()[None])[0]
        return np.array([x, y]) / z * calibration.focal_px + calibration.principal_point_px

    def in_view(self, pixels: np.ndarray) -> np.ndarray:
        """Return a mask of the pixels inside the image (n,)."""
        calibration = self.robot.calibration
        assert calibration is not None
        size = np.array(calibration.image_size_px)
        return ((pixels >= 0) & (pixels < size)).all(axis=1)
