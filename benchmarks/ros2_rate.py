"""Joint states over zenoh on the loopback interface: messages received, their cost, and the error of their timestamps.

One process is robot and router, another reads. Type: python -m benchmarks.ros2_rate
"""

from __future__ import annotations

import argparse
import math
import multiprocessing
import time
from collections.abc import Callable
from multiprocessing.synchronize import Event

import numpy as np

from bodyschema.drivers.ros2.config import Ros2Config
from bodyschema.drivers.ros2.emulator.node import Node
from bodyschema.drivers.ros2.emulator.zenoh_robot import ZenohRobot
from bodyschema.drivers.ros2.joints import Ros2Joints
from bodyschema.interfaces.clock import SystemClock

ENDPOINT = "tcp/127.0.0.1:27447"
JOINTS = tuple(f"joint{k}" for k in range(1, 8))
LEAD_S = 0.5  # the reader is at work before the first message


def swing(phase: float) -> Callable[[float], float]:
    """Return the motion of a joint moved by hand, an angle [rad] by time [s]."""
    return lambda t: 1.2 * math.sin(0.7 * t + phase)


def publish(rate_hz: float, count: int, ready: Event, done: Event) -> None:
    """Publish `count` messages on schedule as the robot does, starting when a subscriber is ready."""
    node = Node({name: swing(place) for place, name in enumerate(JOINTS)}, rate_hz)
    with ZenohRobot([node], ENDPOINT) as robot:
        ready.set()
        while not robot.is_heard:
            time.sleep(0.01)
        first = time.monotonic() + LEAD_S
        for number in range(count):
            due = first + number / rate_hz
            time.sleep(max(0.0, due - time.monotonic()))
            robot.publish(node, due)
        done.wait()


def measure(rate_hz: float, seconds: float) -> str:
    """Read at `rate_hz` for `seconds`; return a line of results."""
    count = round(rate_hz * seconds)
    context = multiprocessing.get_context("spawn")
    ready, done = context.Event(), context.Event()
    robot = context.Process(target=publish, args=(rate_hz, count, ready, done))
    robot.start()
    try:
        ready.wait()
        config = Ros2Config(router=ENDPOINT)
        with Ros2Joints(config, JOINTS, SystemClock()) as joints:
            off: list[float] = []
            used = begin = 0.0
            while joints.received < count:
                reading = joints.read(1.0)
                if reading is None:
                    if off:
                        break
                    continue
                if not off:
                    used, begin = time.process_time(), time.monotonic()
                off.append(reading.t - _published(joints.stamp_ns))
            share = (time.process_time() - used) / (time.monotonic() - begin)
            received, lost, refused = joints.received, joints.lost, sum(joints.refused.values())
    finally:
        done.set()
        robot.join()
    p50, p99 = np.percentile(np.abs(off[len(off) // 10 :]), (50, 99)) * 1e3
    return (
        f"{rate_hz:g} Hz: {received} of {count} messages, {lost} lost, {refused} refused, {len(off)} readings, "
        f"{share:.1%} of a core, times off by {p50:.3f} ms (p50), {p99:.3f} ms (p99)"
    )


def _published(stamp_ns: int | None) -> float:
    """Return the time [s] at which the benchmark stamped the message, on the shared monotonic clock."""
    assert stamp_ns is not None
    return (stamp_ns - Node({}, 1.0).stamp_ns(0.0)) * 1e-9


def main() -> None:
    """Print a line for each rate."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=20.0)
    seconds = parser.parse_args().seconds
    for rate_hz in (100.0, 500.0, 1000.0, 2000.0):
        print(measure(rate_hz, seconds), flush=True)


if __name__ == "__main__":
    main()
