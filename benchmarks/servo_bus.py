"""Six servos on a pseudo-terminal with the wire time of 1 Mbit/s: rate, processor time and time stamps of the driver.

Type: python -m benchmarks.servo_bus
"""

from __future__ import annotations

import argparse
import math
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from drivers.bench.pty_shell import PtyShell
from drivers.dynamixel.bench.chain import Chain
from drivers.dynamixel.bench.servo import Servo
from drivers.dynamixel.config import BusConfig, DynamixelConfig, ServoConfig
from drivers.dynamixel.joints import DynamixelJoints
from drivers.dynamixel.models import BY_NAME
from interfaces.clock import SystemClock

MODEL = "XM430-W350"


def swing(phase: float) -> Callable[[float], float]:
    """A joint moved by hand."""
    return lambda t: 1.2 * math.sin(0.7 * t + phase)


def measure(seconds: float, return_delay_s: float, *, is_fast: bool) -> str:
    """A line about reading for so long."""
    ids = range(1, 7)
    servos = [Servo(BY_NAME[MODEL], k, swing(k), return_delay_s=return_delay_s, booted_s=0.1234 * k) for k in ids]
    entries = tuple(ServoConfig(f"joint{k}", k, MODEL) for k in ids)
    with tempfile.TemporaryDirectory() as folder, PtyShell(Chain(servos), Path(folder) / "bus") as shell:
        bus = BusConfig(str(shell.link), fast_sync_read="auto" if is_fast else "never")
        config = DynamixelConfig({"arm": bus}, entries)
        with DynamixelJoints(config, [entry.joint for entry in entries], SystemClock()) as joints:
            off: list[float] = []
            begin, used = time.monotonic(), time.thread_time()
            while time.monotonic() < begin + seconds:
                reading = joints.read(0.1)
                if reading is not None:
                    truth = [sampling.t for sampling in shell.device.samplings.values()]
                    off.append(reading.t - float(np.mean(truth)))
            spent, elapsed = time.thread_time() - used, time.monotonic() - begin
            dropped = joints.dropped
    p50, p99 = np.percentile(np.abs(off), (50, 99)) * 1e3
    return (
        f"{len(off) / elapsed:.0f} readings/s, {spent / elapsed:.1%} of a core, {dropped} dropped, "
        f"time stamps off by {p50:.3f} ms (p50), {p99:.3f} ms (p99)"
    )


def main() -> None:
    """Print a line for each way of reading."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=5.0)
    seconds = parser.parse_args().seconds
    for is_fast in (True, False):
        for delay_us in (0, 500):
            name = f"{'Fast Sync Read' if is_fast else 'Sync Read'}, return delay {delay_us} us"
            print(f"{name}: {measure(seconds, delay_us * 1e-6, is_fast=is_fast)}", flush=True)


if __name__ == "__main__":
    main()
