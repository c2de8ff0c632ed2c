"""How many wrong readings the Dynamixel driver believes when answers are lost, late, corrupt, cut, swapped, in garbage.

Virtual time, so millions of transactions in minutes. Type: python -m benchmarks.fault_storm --transactions 10_000_000
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable
from random import Random

from drivers.bench.virtual_port import VirtualClock, VirtualPort
from drivers.dynamixel.bench.chain import Chain
from drivers.dynamixel.bench.faults import Storm, storm
from drivers.dynamixel.bench.servo import Servo
from drivers.dynamixel.config import BusConfig, DynamixelConfig, ServoConfig
from drivers.dynamixel.joints import DynamixelJoints
from drivers.dynamixel.models import BY_NAME
from interfaces.errors import SourceLost

ARMS = {
    "Protocol 2.0, Sync Read": ("XM430-W350", "never"),
    "Protocol 2.0, Fast Sync Read": ("XM430-W350", "auto"),
    "Protocol 1.0": ("MX-28", "never"),
}
JOINTS = 3
FASTEST = 1.2 * 0.7  # [rad/s], of the paths below
TIMING_S = 2e-3  # all joints count as read at one time
TELL_EVERY_S = 30.0


def swing(phase: float) -> Callable[[float], float]:
    """A joint moved by hand."""
    return lambda t: 1.2 * math.sin(0.7 * t + phase)


def run(model: str, fast: str, transactions: int, intensity: float, seed: int) -> str:
    """So many transactions with so many answers struck; a line about them."""
    clock, rng = VirtualClock(), Random(seed)
    servos = [Servo(BY_NAME[model], k, swing(k), return_delay_s=0.0, booted_s=0.1 * k) for k in range(1, JOINTS + 1)]
    chain = Chain(servos)
    port = VirtualPort(chain, clock, outwards=lambda: rng.uniform(0, 1e-4), inwards=lambda: rng.uniform(0, 3e-4))
    names = [f"joint{k}" for k in range(1, JOINTS + 1)]
    entries = tuple(ServoConfig(name, k, model) for k, name in enumerate(names, 1))
    config = DynamixelConfig({"arm": BusConfig("bench", fast_sync_read="auto" if fast == "auto" else "never")}, entries)
    limits = [(-2.0, 2.0)] * JOINTS
    joints = DynamixelJoints(config, names, clock, limits=limits, open_port=lambda *_: (port, 2e-4))
    tolerance = BY_NAME[model].rad_per_tick + FASTEST * TIMING_S
    faults: Storm | None = None
    believed = wrong = losses = 0
    worst = 0.0
    told = time.monotonic()
    calm = chain.faults
    while chain.instructions < transactions:
        chain.faults = calm
        with joints:
            chain.faults = faults = storm(intensity, rng) if faults is None else faults
            try:
                while chain.instructions < transactions:
                    reading = joints.read(1.0)
                    if reading is None:
                        continue
                    off = max(abs(q - swing(k)(reading.t)) for k, q in enumerate(reading.q.tolist(), 1))
                    believed, wrong, worst = believed + 1, wrong + (off > tolerance), max(worst, off)
                    if time.monotonic() - told > TELL_EVERY_S:
                        told = time.monotonic()
                        print(f"  {chain.instructions:,} transactions, {wrong} wrong", flush=True)
            except SourceLost:
                losses += 1
    struck = 0 if faults is None else sum(faults.struck.values())
    share = believed / (believed + joints.dropped)
    possible = (1 - intensity) ** (1 if fast == "auto" else JOINTS)
    return (
        f"{chain.instructions:,} transactions, {struck:,} faults, {believed:,} readings believed, "
        f"{wrong} of them wrong (worst {math.degrees(worst):.2f}°), "
        f"{share:.4f} of the readings where faults leave {possible:.4f}, "
        f"opened anew {losses} times"
    )


def main() -> None:
    """Print a line for each kind of bus."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--transactions", type=int, default=100_000, help="shared among the kinds of bus")
    parser.add_argument("--intensity", type=float, default=0.02, help="probability that an answer is struck")
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    for name, (model, fast) in ARMS.items():
        begin = time.monotonic()
        line = run(model, fast, given.transactions // len(ARMS), given.intensity, given.seed)
        print(f"{name}: {line}, {time.monotonic() - begin:.0f} s")


if __name__ == "__main__":
    main()
