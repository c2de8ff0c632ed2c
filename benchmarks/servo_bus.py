"""Six servos on a pseudo-terminal with the wire time of 1 Mbit/s: rate, CPU time and timestamps of the drivers.

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

from bodyschema.drivers.dynamixel.config import BusConfig, DynamixelConfig, ServoConfig
from bodyschema.drivers.dynamixel.emulator.chain import Chain
from bodyschema.drivers.dynamixel.emulator.servo import CURRENT_MODE, Servo
from bodyschema.drivers.dynamixel.joints import DynamixelJoints
from bodyschema.drivers.dynamixel.models import BY_NAME
from bodyschema.drivers.dynamixel.powered_config import FloatingJoint, ZeroForceConfig
from bodyschema.drivers.dynamixel.zero_force import ZeroForce
from bodyschema.drivers.emulator.device import Device, Sampling
from bodyschema.drivers.emulator.pty_shell import PtyShell
from bodyschema.drivers.feetech.config import BusConfig as FeetechBus
from bodyschema.drivers.feetech.config import FeetechConfig
from bodyschema.drivers.feetech.emulator.arm import Chain as FeetechChain
from bodyschema.drivers.feetech.emulator.servo import Servo as FeetechServo
from bodyschema.drivers.feetech.joints import FeetechJoints
from bodyschema.drivers.feetech.models import BY_NAME as FEETECH_MODELS
from bodyschema.drivers.servos.joints import ServoJoints
from bodyschema.interfaces.clock import SystemClock

IDS = range(1, 7)
NAMES = [f"joint{k}" for k in IDS]
MODEL, FEETECH_MODEL = "XM430-W350", "STS3215"
Open = Callable[[str], ServoJoints]


def swing(phase: float) -> Callable[[float], float]:
    """Return the motion of a joint moved by hand, an angle [rad] by time [s]."""
    return lambda t: 1.2 * math.sin(0.7 * t + phase)


def dynamixel(return_delay_s: float, *, is_fast: bool) -> tuple[Chain, Open]:
    """Return a chain of Dynamixel servos, and a function that opens the driver at a port."""
    servos = [Servo(BY_NAME[MODEL], k, swing(k), return_delay_s=return_delay_s, booted_s=0.1234 * k) for k in IDS]
    entries = tuple(ServoConfig(name, k, MODEL) for name, k in zip(NAMES, IDS, strict=True))

    def driver(port: str) -> ServoJoints:
        bus = BusConfig(port, fast_sync_read="auto" if is_fast else "never")
        return DynamixelJoints(DynamixelConfig({"arm": bus}, entries), NAMES, SystemClock())

    return Chain(servos), driver


def floating(return_delay_s: float) -> tuple[Chain, Open]:
    """Return a chain of Dynamixel servos that carry their part of the arm while they are read, and its opener."""
    chain, _ = dynamixel(return_delay_s, is_fast=True)
    for servo in chain.servos:
        servo["operating_mode"] = CURRENT_MODE
    table = ZeroForceConfig(joints={name: FloatingJoint(current_limit_a=1.0) for name in NAMES}, heartbeat_ms=500)
    entries = tuple(ServoConfig(name, k, MODEL) for name, k in zip(NAMES, IDS, strict=True))

    def driver(port: str) -> ServoJoints:
        config, clock = DynamixelConfig({"arm": BusConfig(port)}, entries, zero_force=table), SystemClock()
        force = ZeroForce(config, table, NAMES, np.cos, clock)
        force.ask(True)
        return DynamixelJoints(config, NAMES, clock, drives=[force])

    return chain, driver


def feetech(return_delay_s: float, *, is_sync: bool) -> tuple[FeetechChain, Open]:
    """Return a chain of Feetech servos, and a function that opens the driver at a port."""
    servos = [FeetechServo(FEETECH_MODELS[FEETECH_MODEL], k, swing(k), return_delay_s=return_delay_s) for k in IDS]
    entries = tuple(ServoConfig(name, k, FEETECH_MODEL) for name, k in zip(NAMES, IDS, strict=True))

    def driver(port: str) -> ServoJoints:
        bus = FeetechBus(port, sync_read="auto" if is_sync else "never")
        return FeetechJoints(FeetechConfig({"arm": bus}, entries), NAMES, SystemClock(), limits=[(-2.0, 2.0)] * 6)

    return FeetechChain(servos), driver


def measure(device: Device, samplings: dict[int, Sampling], driver: Open, seconds: float) -> str:
    """Read for `seconds`; return a line of results."""
    off: list[float] = []
    with tempfile.TemporaryDirectory() as folder, PtyShell(device, Path(folder) / "bus") as shell:
        joints = driver(str(shell.link))
        with joints:
            begin, used = time.monotonic(), time.thread_time()
            while time.monotonic() < begin + seconds:
                reading = joints.read(0.1)
                if reading is not None:
                    off.append(reading.t - float(np.mean([sampling.t for sampling in samplings.values()])))
            held = ", torque to the end" if any(drive.holding for drive in joints.drives) else ""
            spent, elapsed = time.thread_time() - used, time.monotonic() - begin
    p50, p99 = np.percentile(np.abs(off), (50, 99)) * 1e3
    return (
        f"{len(off) / elapsed:.0f} readings/s, {spent / elapsed:.1%} of a core, {joints.dropped} dropped, "
        f"time stamps off by {p50:.3f} ms (p50), {p99:.3f} ms (p99){held}"
    )


def main() -> None:
    """Print a line for each way of reading."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=5.0)
    seconds = parser.parse_args().seconds
    for delay_us in (0, 500):
        for how, (chain, driver) in {
            "Dynamixel, Fast Sync Read": dynamixel(delay_us * 1e-6, is_fast=True),
            "Dynamixel, zero-force": floating(delay_us * 1e-6),
            "Dynamixel, Sync Read": dynamixel(delay_us * 1e-6, is_fast=False),
            "Feetech, Sync Read": feetech(delay_us * 1e-6, is_sync=True),
            "Feetech, one by one": feetech(delay_us * 1e-6, is_sync=False),
        }.items():
            line = measure(chain, chain.samplings, driver, seconds)
            print(f"{how}, return delay {delay_us} us: {line}", flush=True)


if __name__ == "__main__":
    main()
