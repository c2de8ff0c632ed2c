"""Wrong readings accepted by the drivers when answers are lost, late, corrupt, cut, swapped or surrounded by garbage.

Time is virtual, so millions of transactions take minutes:
python -m benchmarks.fault_storm --transactions 10_000_000
Readings per second of six servos when answers are lost: python -m benchmarks.fault_storm --rates
Servos that repeat an answer two transactions old: python -m benchmarks.fault_storm --stale 2 --transactions 36_000
"""

from __future__ import annotations

import argparse
import math
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from random import Random
from typing import Any

from bodyschema.drivers.dynamixel.config import BusConfig, DynamixelConfig, ServoConfig
from bodyschema.drivers.dynamixel.emulator.arm import swapped
from bodyschema.drivers.dynamixel.emulator.chain import Chain
from bodyschema.drivers.dynamixel.emulator.servo import Servo
from bodyschema.drivers.dynamixel.joints import DynamixelJoints
from bodyschema.drivers.dynamixel.models import BY_NAME
from bodyschema.drivers.emulator.device import Device, Fault
from bodyschema.drivers.emulator.faults import mute
from bodyschema.drivers.feetech.config import BusConfig as FeetechBus
from bodyschema.drivers.feetech.config import FeetechConfig
from bodyschema.drivers.feetech.emulator.arm import Chain as FeetechChain
from bodyschema.drivers.feetech.emulator.arm import swapped as swapped_feetech
from bodyschema.drivers.feetech.emulator.servo import Servo as FeetechServo
from bodyschema.drivers.feetech.joints import FeetechJoints
from bodyschema.drivers.feetech.models import BY_NAME as FEETECH_MODELS
from bodyschema.drivers.serial_lines.config import EncoderConfig, SerialLinesConfig
from bodyschema.drivers.serial_lines.emulator.board import EncoderBoard
from bodyschema.drivers.serial_lines.joints import SerialLineJoints
from bodyschema.interfaces.errors import SourceLost
from tests.daemon.virtual_port import VirtualClock, VirtualPort
from tests.drivers.wire_faults import Storm, storm

JOINTS = 3  # in a storm
JOINTS_OF_AN_ARM = 6
LOSSES = (0.0, 0.005, 0.02, 0.05)
LATENCY_S = 2e-4  # of the adapter
LIMITS = (-2.0, 2.0)
FASTEST = 1.2 * 0.7  # [rad/s], of the paths below
TIMING_S = 2e-3  # all joints count as read at one time
LINE_BAUD = 460_800
TELL_EVERY_S = 30.0


def swing(phase: float) -> Callable[[float], float]:
    """Return the motion of a joint moved by hand, an angle [rad] by time [s]."""
    return lambda t: 1.2 * math.sin(0.7 * t + phase)


@dataclass
class Rig:
    """A driver with an emulated device.

    Attributes:
        device: emulated device into which the faults are injected.
        transactions: returns the number of transactions so far (queries, or lines).
        rad_per_tick: resolution of the sensors.
        parts: number of answers that make a reading.
    """

    device: Any
    joints: Any
    transactions: Callable[[], int]
    storm: Callable[[float, Random], Storm]
    rad_per_tick: float
    parts: int


def _port(device: Device, clock: VirtualClock, rng: Random, baud: int = 1_000_000) -> VirtualPort:
    return VirtualPort(device, clock, baud, outwards=lambda: rng.uniform(0, 1e-4), inwards=lambda: rng.uniform(0, 3e-4))


def _storm(swapped: Fault, intensity: float, rng: Random) -> Storm:
    return storm(intensity, rng, swapped)


def names(count: int) -> list[str]:
    """Return the names of the joints."""
    return [f"joint{k}" for k in range(1, count + 1)]


def dynamixel(clock: VirtualClock, rng: Random, count: int, model: str, *, is_fast: bool) -> Rig:
    """Return a rig of Dynamixel servos."""
    ids = range(1, count + 1)
    chain = Chain(Servo(BY_NAME[model], k, swing(k), return_delay_s=0.0, booted_s=0.1 * k) for k in ids)
    port = _port(chain, clock, rng)
    bus = BusConfig("emulator", fast_sync_read="auto" if is_fast else "never")
    config = DynamixelConfig({"arm": bus}, tuple(ServoConfig(name, k, model) for k, name in enumerate(names(count), 1)))
    limits = [LIMITS] * count
    joints = DynamixelJoints(config, names(count), clock, limits=limits, open_port=lambda *_: (port, LATENCY_S))
    step, parts = BY_NAME[model].rad_per_tick, 1 if is_fast else count
    return Rig(chain, joints, lambda: chain.instructions, partial(_storm, swapped), step, parts)


def feetech(clock: VirtualClock, rng: Random, count: int, model: str) -> Rig:
    """Return a rig of Feetech servos."""
    servos = (FeetechServo(FEETECH_MODELS[model], k, swing(k), return_delay_s=0.0) for k in range(1, count + 1))
    chain = FeetechChain(servos)
    port = _port(chain, clock, rng)
    entries = tuple(ServoConfig(name, k, model) for k, name in enumerate(names(count), 1))
    config = FeetechConfig({"arm": FeetechBus("emulator")}, entries)
    limits = [LIMITS] * count
    joints = FeetechJoints(config, names(count), clock, limits=limits, open_port=lambda *_: (port, LATENCY_S))
    step = FEETECH_MODELS[model].rad_per_tick
    return Rig(chain, joints, lambda: chain.instructions, partial(_storm, swapped_feetech), step, count)


def lines(clock: VirtualClock, rng: Random, count: int) -> Rig:
    """Return a rig of custom encoders."""
    encoders = {name: (4096, swing(k)) for k, name in enumerate(names(count), 1)}
    board = EncoderBoard(encoders, begun_s=clock.now(), drift=1e-4)
    port = _port(board, clock, rng, LINE_BAUD)
    config = SerialLinesConfig("emulator", tuple(EncoderConfig(name) for name in names(count)), LINE_BAUD)
    joints = SerialLineJoints(config, names(count), clock, limits=[LIMITS] * count, open_port=lambda *_: port)
    return Rig(board, joints, lambda: board.lines, storm, 2 * math.pi / 4096, 1)


Make = Callable[[VirtualClock, Random, int], Rig]
KINDS: dict[str, Make] = {
    "Dynamixel Protocol 2.0, Sync Read": partial(dynamixel, model="XM430-W350", is_fast=False),
    "Dynamixel Protocol 2.0, Fast Sync Read": partial(dynamixel, model="XM430-W350", is_fast=True),
    "Dynamixel Protocol 1.0": partial(dynamixel, model="MX-28", is_fast=False),
    "Feetech STS, Sync Read": partial(feetech, model="STS3215"),
    "Feetech SCS": partial(feetech, model="SCS0009"),
    "serial lines": lines,
}


class Stale:
    """A fault: a servo repeats the data of an earlier answer of the same length, with a correct checksum."""

    def __init__(self, back: int) -> None:
        self._back = back
        self._given: dict[tuple[int, int], deque[bytes]] = {}

    def __call__(self, reply: Any, rng: Random) -> Any:  # noqa: ARG002
        """Return the reply with the data of the answer `back` before this one."""
        return replace(reply, data=self._given[reply.id, len(reply.data)][0])

    def storm(self, share: float, rng: Random) -> Storm:
        """Return a storm that applies this fault to a share of the answers."""
        return _Remembered({"stale": (share, self)}, rng, self)

    def keep(self, reply: Any) -> None:
        """Remember the servo's correct answer."""
        self._given.setdefault((reply.id, len(reply.data)), deque(maxlen=self._back + 1)).append(reply.data)


class _Remembered(Storm):
    def __init__(self, faults: Any, rng: Random, stale: Stale) -> None:
        super().__init__(faults, rng)
        self._stale = stale

    def __call__(self, reply: Any) -> Any:
        self._stale.keep(reply)
        return super().__call__(reply)


def run(make: Make, transactions: int, intensity: float, seed: int, back: int | None = None) -> str:
    """Run a storm of faults until the number of transactions is reached; return a line of results.

    Args:
        intensity: probability that an answer is faulty.
        back: if given, the only fault is stale data, this many answers old.
    """
    clock, rng = VirtualClock(), Random(seed)
    rig = make(clock, rng, JOINTS)
    tolerance = rig.rad_per_tick + FASTEST * TIMING_S
    storm = rig.storm if back is None else Stale(back).storm
    rig.device.faults = faults = storm(intensity, rng)
    believed = wrong = losses = 0
    worst = 0.0
    told = time.monotonic()
    while rig.transactions() < transactions:
        try:
            with rig.joints:
                while rig.transactions() < transactions:
                    reading = rig.joints.read(1.0)
                    if reading is None:
                        continue
                    off = max(abs(q - swing(k)(reading.t)) for k, q in enumerate(reading.q.tolist(), 1))
                    believed, wrong, worst = believed + 1, wrong + (off > tolerance), max(worst, off)
                    if time.monotonic() - told > TELL_EVERY_S:
                        told = time.monotonic()
                        print(f"  {rig.transactions():,} transactions, {wrong} wrong", flush=True)
        except SourceLost:
            losses += 1
    struck = sum(faults.struck.values())
    asked = rig.transactions() if rig.joints.__class__ is SerialLineJoints else believed + rig.joints.dropped
    possible = (1 - intensity) ** rig.parts
    return (
        f"{rig.transactions():,} transactions, {struck:,} faults, {believed:,} readings believed, "
        f"{wrong} of them wrong (worst {math.degrees(worst):.2f}°), "
        f"{believed / asked:.4f} of the readings where faults leave {possible:.4f}, "
        f"opened anew {losses} times"
    )


def rate(make: Make, loss: float, seconds: float, seed: int) -> float:
    """Return the readings per second of virtual time, openings included, when the share `loss` of answers is lost."""
    clock, rng = VirtualClock(), Random(seed)
    rig, readings, begin = make(clock, rng, JOINTS_OF_AN_ARM), 0, clock.now()
    rig.device.faults = Storm({"mute": (loss, mute)}, rng)
    while clock.now() < begin + seconds:
        with suppress(SourceLost), rig.joints:
            while clock.now() < begin + seconds:
                readings += rig.joints.read(1.0) is not None
    return readings / (clock.now() - begin)


def rates(make: Make, seconds: float, seed: int) -> str:
    """Return a line with the rate at each loss, and its ratio to the rate without losses."""
    found = [rate(make, loss, seconds, seed) for loss in LOSSES]
    return ", ".join(
        f"{100 * loss:g} % lost: {each:.0f}/s ({each / found[0]:.2f})" for loss, each in zip(LOSSES, found, strict=True)
    )


def main() -> None:
    """Print a line for each kind of bus."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--transactions", type=int, default=100_000, help="shared among the kinds of bus")
    parser.add_argument("--intensity", type=float, default=0.02, help="probability that an answer is struck")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--stale", type=int, metavar="BACK", help="answers with the data of that many answers before")
    parser.add_argument("--rates", action="store_true", help="readings per second by the share of answers lost")
    parser.add_argument("--seconds", type=float, default=20.0, help="of each rate, in virtual time")
    parser.add_argument("--only", choices=tuple(KINDS), help="this kind alone")
    given = parser.parse_args()
    kinds = KINDS if given.only is None else {given.only: KINDS[given.only]}
    if given.stale is not None:
        kinds = {name: make for name, make in kinds.items() if make is not lines}
    for name, make in kinds.items():
        if given.rates:
            print(f"{name}: {rates(make, given.seconds, given.seed)}", flush=True)
            continue
        begin = time.monotonic()
        line = run(make, given.transactions // len(kinds), given.intensity, given.seed, given.stale)
        print(f"{name}: {line}, {time.monotonic() - begin:.0f} s", flush=True)


if __name__ == "__main__":
    main()
