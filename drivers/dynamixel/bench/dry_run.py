"""The servos that a robot.toml describes, on pseudo-terminals."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from random import Random
from types import TracebackType
from typing import Self

import msgspec

from drivers.bench.pty_shell import PtyShell
from drivers.dynamixel.config import DynamixelConfig, ServoConfig
from drivers.dynamixel.models import baud_value

from .asked_faults import NOW_AND_THEN, OF_A_SERVO, ON_THE_WIRE, AskedFault, WireFaults
from .chain import Chain
from .servo import Angle, Servo

EVERY_S = 10.0  # what happens now and then
UNPLUGGED_S = 3.0
GLITCH_S = 0.1
GLITCH_TICKS = 700
OTHER_BAUD = {57600: 1_000_000}  # any other rate: 57600

Event = tuple[float, str, Callable[[], None]]


class DryRun:
    """Servos as they are configured, each bus behind a port of its own. Ended with its with statement.

    Attributes:
        config: the configuration with the bench's ports in the place of those that it names.
        chains, shells: by name of the bus.
    """

    def __init__(
        self,
        config: DynamixelConfig,
        angles: Mapping[str, Angle],
        links: Mapping[str, Path],
        *,
        faults: Sequence[AskedFault] = (),
        return_delay_s: float = 0.0,
        seed: int = 0,
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        """Nothing is there yet.

        Args:
            config: checked.
            angles: by joint, its angle at a time [rad].
            links: by bus, the name of its port.
            return_delay_s: Return Delay Time of all servos.
            seed: of the faults on the wire.
        """
        self._faults, self._now = tuple(faults), now
        self._servos: dict[str, Servo] = {}
        self._opened = ExitStack()
        rng = Random(seed)
        self.chains: dict[str, Chain] = {}
        for name, bus in config.buses.items():
            fitted = [servo for servo in config.servos if config.bus_of(servo) == name]
            ids = {servo.joint: servo.id for servo in fitted}
            for servo in fitted:
                angle = _shaft(config, servo, angles[servo.joint])
                baud, model = bus.baud, config.model_of(servo)
                self._servos[servo.joint] = Servo(
                    model, servo.id, angle, baud=baud, return_delay_s=return_delay_s, booted_s=now() - rng.uniform(1, 9)
                )
            self.chains[name] = Chain([self._servos[joint] for joint in ids], _wire(self._faults, ids, rng))
        self._begin(config)
        self.shells = {name: PtyShell(chain, links[name], now) for name, chain in self.chains.items()}
        ports = {name: msgspec.structs.replace(bus, port=str(links[name])) for name, bus in config.buses.items()}
        self.config = msgspec.structs.replace(config, buses=ports)

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            for shell in self.shells.values():
                stack.enter_context(shell)
            self._opened = stack.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._opened.close()

    @property
    def instructions(self) -> int:
        """How many packets the servos understood."""
        return sum(chain.instructions for chain in self.chains.values())

    def servo(self, joint: str) -> Servo:
        """The servo of a joint."""
        return self._servos[joint]

    def events(self) -> Iterator[Event]:
        """What happens from now on because it was asked for: after how many seconds, what, and how to do it."""
        asked = [fault for fault in self._faults if fault.kind in NOW_AND_THEN]
        while asked:
            for fault in asked:
                yield from self._happening(fault)

    def _happening(self, fault: AskedFault) -> Iterator[Event]:
        if fault.kind == "unplug":
            yield EVERY_S, "unplugged", lambda: self._each(PtyShell.unplug)
            yield UNPLUGGED_S, "plugged in again", lambda: self._each(PtyShell.plug_in)
        elif fault.kind == "power-cycle":
            yield EVERY_S, "the servos lose their power and get it back", self._power_cycle
        else:
            servo = self._servos[fault.joint or ""]
            yield EVERY_S, f"the encoder of {fault.joint} is wrong for a moment", lambda: _glitch(servo, GLITCH_TICKS)
            yield GLITCH_S, f"the encoder of {fault.joint} is right again", lambda: _glitch(servo, 0)

    def _each(self, act: Callable[[PtyShell], None]) -> None:
        for shell in self.shells.values():
            act(shell)

    def _power_cycle(self) -> None:
        for chain in self.chains.values():
            chain.power_cycle(self._now())

    def _begin(self, config: DynamixelConfig) -> None:
        """What is another way from the beginning."""
        entries = {servo.joint: servo for servo in config.servos}
        for fault in self._faults:
            servo = self._servos.get(fault.joint or "")
            if servo is None:
                continue
            if fault.kind in OF_A_SERVO:
                servo.fail(OF_A_SERVO[fault.kind])
            elif fault.kind == "baud":
                servo["baud"] = baud_value(servo.model.layout, OTHER_BAUD.get(servo.baud, 57600))
            elif fault.kind == "double":
                twin = Servo(servo.model, servo.id, lambda _: 0.1, baud=servo.baud, booted_s=self._now() - 77.7)
                self.chains[config.bus_of(entries[fault.joint or ""])].servos.append(twin)
            elif fault.kind == "torque":
                servo["torque"] = 1


def _shaft(config: DynamixelConfig, servo: ServoConfig, angle: Angle) -> Angle:
    """The shaft's angle [rad], which is 0 in the middle of the servo's range, from that of the joint."""
    model = config.model_of(servo)
    zero = model.zero_ticks if servo.zero_ticks is None else servo.zero_ticks
    shift = (zero - model.zero_ticks) * model.rad_per_tick
    return lambda t: servo.direction * angle(t) + shift


def _wire(faults: Sequence[AskedFault], ids: Mapping[str, int], rng: Random) -> WireFaults:
    here = [fault for fault in faults if fault.kind in ON_THE_WIRE and (fault.joint is None or fault.joint in ids)]
    return WireFaults(
        [(None if f.joint is None else ids[f.joint], f.share, ON_THE_WIRE[f.kind]) for f in here],
        Random(rng.random()),
    )


def _glitch(servo: Servo, ticks: int) -> None:
    servo.glitch_ticks = ticks
