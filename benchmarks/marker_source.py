"""Learn a desk arm from positions that another program sends: the real daemon, sockets and clocks, an emulated arm.

The joints come by ROS 2 (rmw_zenoh). The marker comes by UDP datagrams or NatNet frames, with another clock, noise,
delay and lost packets. The arm differs from its URDF by joint offsets, and the source's frame is arbitrary. Errors are
measured against the true chain on held-out poses.

Type: python -m benchmarks.marker_source [udp|natnet] [--seconds 60] [--rate 100] [--sigma-mm 0.5] [--lost 0.01]
"""

from __future__ import annotations

import argparse
import json
import math
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from bodyschema.daemon.config import Config
from bodyschema.daemon.transport.keys import Keys
from bodyschema.daemon.transport.session import client
from bodyschema.daemon.transport.status import LearnerStatus, SamplerStatus
from bodyschema.daemon.transport.wire import decode
from bodyschema.drivers.markers.datagram import SCHEMA
from bodyschema.drivers.ros2.emulator.node import Node
from bodyschema.drivers.ros2.emulator.zenoh_robot import ZenohRobot
from bodyschema.interfaces.errors import BodyschemaError
from bodyschema.interfaces.records import FloatArray
from bodyschema.robot.description import RobotDescription
from bodyschema.robot.rpy import rotation_of
from tests.daemon.natnet_server import NatnetServer

EXAMPLE = Path(__file__).parents[1] / "examples" / "desk_arm" / "desk_arm.urdf"
JOINTS = ("base_yaw", "shoulder_pitch", "elbow_pitch", "wrist_roll")
CLOCK_AHEAD_S = 4321.0  # the sender's clock
LATENCY_S, JITTER_S = 0.004, 0.002  # from the measurement to the datagram, known to the sender; of the network
POSES = 400
LEVEL = (0.0, 0.0, 0.0, 1.0)
COMMAND = (sys.executable, "-m", "bodyschema")
ROBOT = """[robot]
name = "desk_arm"
urdf = "{urdf}"
joints = {joints}
marker_link = "gripper"
marker_xyz = [0.0, 0.0, 0.03]
marker_known = false
[camera]
parent_link = "base_link"
xyz = [0.0, 0.0, 0.0]
pose_known = false
[zenoh]
sampler = "tcp/127.0.0.1:{sampler}"
learner = "tcp/127.0.0.1:{learner}"
[drivers.ros2]
router = "tcp/127.0.0.1:{router}"
[daemon]
state_dir = "state"
[marker_source]
{source}
"""


class Arm:
    """The true arm, each joint on its own path.

    Attributes:
        is_wiggled: True while it moves to and fro, to measure the latency.
    """

    def __init__(self, description: RobotDescription, rng: np.random.Generator) -> None:
        self.is_wiggled = False
        T = np.eye(4)
        T[:3, :3] = rotation_of(rng.uniform(-0.4, 0.4, 3))
        T[:3, 3] = rng.uniform(-0.3, 0.3, 3)
        marker = np.array([0.0, 0.0, 0.03]) + rng.normal(0.0, 0.005, 3)
        self._chain = description.with_placement(T, marker).chain
        self.zeros = np.radians(rng.normal(0.0, 1.0, len(JOINTS)))
        self._phases = rng.uniform(0, 2 * np.pi, (len(JOINTS), 3))
        self._rates = rng.uniform(0.12, 0.45, (len(JOINTS), 3))

    def path(self, joint: int) -> Callable[[float], float]:
        """Return a joint's reading [rad] as a function of time [s]: a sum of three sines that does not repeat."""
        phases, rates = self._phases[joint], self._rates[joint]

        def reading(t: float) -> float:
            slow = 0.35 * sum(math.sin(rate * t + phase) for rate, phase in zip(rates, phases, strict=True))
            return slow + (0.12 * math.sin((4.0 + 0.7 * joint) * t) if self.is_wiggled else 0.0)

        return reading

    def at(self, t: float) -> FloatArray:
        """Return the readings at `t`."""
        return np.array([self.path(joint)(t) for joint in range(len(JOINTS))])

    def marker(self, q: FloatArray) -> FloatArray:
        """Return the marker's true positions [m] at readings (..., d)."""
        return self._chain.positions(q + self.zeros)


def free_port() -> int:
    """Return a free TCP port."""
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return found.getsockname()[1]


class Sender:
    """Sender of the marker's measured positions at a fixed rate, by UDP or as Motive does."""

    def __init__(self, arm: Arm, arguments: argparse.Namespace, rng: np.random.Generator) -> None:
        self._arm, self._arguments, self._rng = arm, arguments, rng
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._motive = NatnetServer({1: "table", 2: "tool"}) if arguments.kind == "natnet" else None
        self._port = free_port()
        self.sent = 0

    def __enter__(self) -> Sender:
        if self._motive is not None:
            self._motive.__enter__()
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()
        if self._motive is not None:
            self._motive.__exit__(None, None, None)
        self._socket.close()

    @property
    def table(self) -> str:
        """Return the keys of [marker_source]."""
        if self._motive is not None:
            keys = f'kind = "natnet"\ncommand_port = {self._motive.command_port}\nbody = "tool"\n'
        else:
            keys = f'kind = "udp"\nport = {self._port}\n'
        return f"{keys}sigma_m = {1e-3 * self._arguments.sigma_mm}\n"

    def _run(self) -> None:
        due = time.monotonic()
        while not self._stop.wait(max(0.0, due - time.monotonic())):
            x = self._arm.marker(self._arm.at(due)) + self._rng.normal(0.0, 1e-3 * self._arguments.sigma_mm, 3)
            time.sleep(LATENCY_S + self._rng.exponential(JITTER_S))
            self.sent += 1
            self._send(due, x.tolist())
            due = max(due + 1 / self._arguments.rate, time.monotonic() - 0.02)

    def _send(self, t: float, x: list[float]) -> None:
        stamp, is_lost = t + CLOCK_AHEAD_S, self._rng.random() < self._arguments.lost
        if self._motive is not None:
            self._motive.answer()
            poses = {1: ((0.0, 0.0, 0.0), LEVEL), 2: ((x[0], x[1], x[2]), LEVEL)}
            packet = self._motive.frame(poses, stamp, latency_s=LATENCY_S)
            if not is_lost:
                self._motive.send_packet(packet)
            return
        told = {"schema": SCHEMA, "seq": self.sent, "stamp": stamp, "position": x}
        if not is_lost:
            self._socket.sendto(json.dumps(told).encode(), ("127.0.0.1", self._port))


def main() -> None:
    """Run the daemon for a while; print the learnt arm's errors."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("kind", choices=("udp", "natnet"), nargs="?", default="udp")
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--rate", type=float, default=100.0)
    parser.add_argument("--sigma-mm", type=float, default=0.5)
    parser.add_argument("--lost", type=float, default=0.01)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    rng = np.random.default_rng(arguments.seed)
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        ports = {name: free_port() for name in ("sampler", "learner", "router")}
        file = folder / "robot.toml"
        description = _description(file, ports)
        arm = Arm(description, rng)
        node = Node({name: arm.path(joint) for joint, name in enumerate(JOINTS)}, 100.0)
        robot = stack.enter_context(ZenohRobot([node], f"tcp/127.0.0.1:{ports['router']}"))
        robot.start()
        sender = stack.enter_context(Sender(arm, arguments, rng))
        file.write_text(_robot(ports, sender.table))
        arm.is_wiggled = True
        file.write_text(_robot(ports, sender.table + _latency(file)))
        arm.is_wiggled = False
        config = Config.load(file)
        with subprocess.Popen([*COMMAND, "run", "--robot", str(file)], stdout=subprocess.DEVNULL) as run:
            try:
                _report(config, arm, sender, arguments.seconds, rng)
            finally:
                run.send_signal(signal.SIGINT)


def _latency(file: Path) -> str:
    """Measure the latency with the command line, print it, and return its two keys."""
    command = [*COMMAND, "calibrate", "latency", "--seconds", "8", "--json", "--robot", str(file)]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
    found = json.loads(done.stdout)
    print(f"latency {1e3 * found['latency_s']:.2f} ± {1e3 * found['sigma_s']:.2f} ms")
    return f"latency_s = {found['latency_s']}\nlatency_sigma_s = {found['sigma_s']}\n"


def _description(file: Path, ports: dict[str, int]) -> RobotDescription:
    file.write_text(_robot(ports, 'kind = "udp"'))
    return RobotDescription.load(file)


def _robot(ports: dict[str, int], source: str) -> str:
    return ROBOT.format(urdf=EXAMPLE, joints=list(JOINTS), source=source, **ports)


def _report(config: Config, arm: Arm, sender: Sender, seconds: float, rng: np.random.Generator) -> None:
    keys = Keys(config.robot.name)
    held_out = np.array([arm.at(t) for t in rng.uniform(1e5, 2e5, POSES)])
    truth = arm.marker(held_out)
    begin = time.monotonic()
    while time.monotonic() - begin < seconds:
        time.sleep(min(10.0, seconds / 4))
        try:
            with client(config.route("learner")) as learner, client(config.route("sampler")) as sampler:
                told = json.loads(learner.ask_one(keys.predict, json.dumps({"q": held_out.tolist()}).encode()))
                status = decode(sampler.ask_one(keys.status("sampler")), SamplerStatus)
                model = decode(learner.ask_one(keys.status("learner")), LearnerStatus)
        except BodyschemaError as error:
            print(f"{time.monotonic() - begin:4.0f} s: {error}")
            continue
        inside = np.array(told["in_support"])
        off = np.linalg.norm(np.array(told["x"]) - truth, axis=1)
        sigma = np.array(told["sigma"])
        within = np.abs(np.array(told["x"]) - truth) < sigma.reshape(len(sigma), -1)
        print(
            f"{time.monotonic() - begin:4.0f} s: {status.pairs} pairs, {status.pairs_per_s:.1f}/s, "
            f"{status.frames_per_s:.0f} positions/s of {sender.sent} sent, {model.model}: error "
            f"{1e3 * off.mean():.2f} mm mean, {1e3 * np.quantile(off, 0.95):.2f} mm 95 %, in support "
            f"{100 * inside.mean():.0f} %, {100 * within.mean():.0f} % within 1-sigma; rejected {status.rejected}"
        )
        for complaint in status.health:
            print(f"        {complaint}")


if __name__ == "__main__":
    main()
