"""One hand-guided path of the simulated arm through every driver gives the same model, to within encoder resolution."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest
from emulated_arm import Arm
from feetech_arm import FeetechArm
from free_ports import free_endpoint
from servo_arm import TICK
from test_serial_lines import BoardArm
from virtual_port import VirtualClock

from bodyschema.drivers.emulator.device import Angle
from bodyschema.drivers.emulator.servo_arm import played
from bodyschema.drivers.ros2.config import Ros2Config
from bodyschema.drivers.ros2.emulator.node import Node
from bodyschema.drivers.ros2.emulator.zenoh_robot import ZenohRobot
from bodyschema.drivers.ros2.joints import Ros2Joints
from bodyschema.drivers.ros2.link import Link, Sample, open_zenoh
from bodyschema.interfaces.protocols import JointSource
from bodyschema.interfaces.records import FloatArray, JointReading
from bodyschema.robot.description import RobotDescription
from bodyschema.sim_backend import SimConfig, SimWorld
from bodyschema.sim_backend.world import guided_path
from kbmaps import ExactLearner, JointBasis, KBMap

pytestmark = pytest.mark.skipif(find_spec("pybullet") is None, reason="no pybullet; to run it: pip install -e '.[sim]'")

ROBOT = Path(__file__).parents[2] / "examples" / "desk_arm" / "robot.toml"
CONFIG = SimConfig()
SECONDS, RATE_HZ = 6.0, 60.0
BEGIN_S = 101.0  # time of the path on the emulators' clocks, which start at 100: until then drivers open
LATENCY_S = 1e-3


@dataclass(frozen=True)
class Guided:
    """An arm, and the path along which the virtual hand guided it."""

    robot: RobotDescription
    path: FloatArray  # (n, d) [rad]

    def angles(self, begin_s: float) -> list[Angle]:
        """Return the angle of each joint as a function of time, the path beginning at `begin_s`."""
        return played(self.path, CONFIG.encoders.rate_hz, begin_s)

    @property
    def limits(self) -> list[tuple[float, float]]:
        return list(zip(self.robot.lower.tolist(), self.robot.upper.tolist(), strict=True))

    @property
    def reach_m(self) -> float:
        """The marker is nowhere farther from a joint than this."""
        return sum(float(np.linalg.norm(T[:3, 3])) for T in self.robot.chain.fixed[1:])

    def learnt(self, q: FloatArray, true_q: FloatArray) -> KBMap:
        """Return the map learned from readings `q` and an error-free camera, (n, d) [rad] both."""
        bases = (JointBasis.orthonormal(-1.0, 1.0),) * len(self.robot.joints)
        learner = ExactLearner(KBMap(bases, np.zeros((3,) * (len(bases) + 1))))
        learner.learn(q, self.robot.chain.positions(true_q))
        return learner.solve().map


@cache
def guided() -> Guided:
    robot = RobotDescription.load(ROBOT)
    return Guided(robot, guided_path(robot, CONFIG, SECONDS))


class PacedLink:
    """A robot's messages over zenoh, each sent at its virtual time: no wait but zenoh's own."""

    def __init__(self, inner: Link, robot: ZenohRobot, node: Node, clock: VirtualClock) -> None:
        self._inner, self._robot, self._node, self._clock = inner, robot, node, clock
        self._due = clock.now()

    def __getattr__(self, name: str) -> object:
        return getattr(self._inner, name)

    def receive(self, until: float) -> Sample | None:
        if self._due > until:
            self._clock.wait_until(until)
            return None
        while not self._robot.is_heard:
            continue
        self._clock.wait_until(self._due)
        self._robot.publish(self._node, self._due)
        self._due += self._node.period_s
        return self._inner.receive(self._clock.now() + 1.0)


@contextmanager
def ros2(arm: Guided) -> Iterator[tuple[JointSource, float]]:
    clock = VirtualClock()
    node = Node(dict(zip(arm.robot.joints, arm.angles(BEGIN_S), strict=True)), RATE_HZ)
    endpoint = free_endpoint()
    with ZenohRobot([node], endpoint) as robot:
        yield (
            Ros2Joints(
                Ros2Config(router=endpoint),
                arm.robot.joints,
                clock,
                open_link=lambda *settings: PacedLink(open_zenoh(*settings), robot, node, clock),  # pyright: ignore
            ),
            BEGIN_S,
        )


@contextmanager
def simulated(arm: Guided) -> Iterator[tuple[JointSource, float]]:
    with patch("bodyschema.sim_backend.world.RenderProcess"), SimWorld(arm.robot, CONFIG) as world:
        yield world.joints, 1 / CONFIG.encoders.rate_hz


def on_emulator(make: Callable[..., Arm | FeetechArm | BoardArm], **more: object):
    @contextmanager
    def opened(arm: Guided) -> Iterator[tuple[JointSource, float]]:
        settings = {"paths": arm.angles(BEGIN_S), "limits": arm.limits, "latency_s": LATENCY_S, "rate_hz": RATE_HZ}
        yield make(**settings, **more).joints, BEGIN_S

    return opened


SOURCES = {
    "simulated source": simulated,
    "Dynamixel 2.0": on_emulator(Arm, models=("XM430-W350",) * 4),
    "Dynamixel 1.0": on_emulator(Arm, models=("MX-28",) * 4),
    "Feetech": on_emulator(FeetechArm, models=("STS3215",) * 4),
    "serial lines": on_emulator(BoardArm),
    "ROS 2": ros2,
}


def readings_of(joints: JointSource, until: float) -> list[JointReading]:
    readings: list[JointReading] = []
    with joints:
        while not readings or readings[-1].t < until:
            reading = joints.read(1.0)
            if reading is not None:
                readings.append(reading)
    return readings


QUICK = ("simulated source", "Dynamixel 2.0", "Feetech")


@pytest.mark.parametrize(
    "source", [*QUICK, *(pytest.param(name, marks=pytest.mark.soak) for name in SOURCES if name not in QUICK)]
)
def test_every_driver_yields_same_model_from_one_path(source) -> None:
    arm = guided()
    with SOURCES[source](arm) as (joints, begin_s):
        readings, angles = readings_of(joints, begin_s + SECONDS - 0.1), arm.angles(begin_s)
    q = np.array([reading.q for reading in readings])
    true_q = np.array([[angle(reading.t) for angle in angles] for reading in readings])
    through_driver, exact = arm.learnt(q, true_q), arm.learnt(arm.path, arm.path)
    poses = arm.path[::50]
    apart_m = np.linalg.norm(through_driver.predict(poses) - exact.predict(poses), axis=1)
    assert apart_m.max() < TICK * arm.reach_m
