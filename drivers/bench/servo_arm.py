"""The servos that a robot.toml describes, on a bench."""

from __future__ import annotations

import time
from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from random import Random
from typing import Any, ClassVar, Generic, Protocol, TypeVar

import msgspec

from bodyschema.drivers.servos.config import ServoConfig, ServosConfig

from .asked_faults import AskedFault, FaultKinds, WireFaults
from .chain import AnyServo, ServoChain
from .device import Faults
from .dry_run import Angle, BenchArm

GLITCH_TICKS = 700
AT_THE_START = ("baud", "double", "torque")
TWIN_RAD = 0.1  # where a second servo of one ID stands


class BenchServo(AnyServo, Protocol):
    """What is done to a servo on a bench."""

    glitch_ticks: int

    def __setitem__(self, name: str, value: int) -> None:
        """Put a number into a register as the servo itself does, past all locks."""
        ...

    def fail(self, bits: int) -> None:
        """Something is wrong with it, until it is rebooted."""
        ...


ServoT = TypeVar("ServoT", bound=BenchServo)
ConfigT = TypeVar("ConfigT", bound=ServosConfig[Any])


class ServoArm(BenchArm, Generic[ServoT, ConfigT]):
    """Servos as they are configured, on one chain for each bus.

    Attributes:
        chains: by name of the bus.
    """

    unit: ClassVar[str] = "packets understood"
    kinds: ClassVar[FaultKinds]
    errors: ClassVar[Mapping[str, int]]
    """Bits of what is wrong with a servo, by the names of the faults."""

    def __init__(
        self,
        config: ConfigT,
        angles: Mapping[str, Angle],
        *,
        faults: Sequence[AskedFault] = (),
        return_delay_s: float = 0.0,
        seed: int = 0,
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        """The servos with their power on.

        Args:
            config: checked.
            angles: by joint, its angle at a time [rad].
            return_delay_s: after how long all of them answer.
            seed: of the faults on the wire.
        """
        self._config, self._return_delay_s, self._rng, self._now = config, return_delay_s, Random(seed), now
        self._servos: dict[str, ServoT] = {}
        self.chains: dict[str, ServoChain[ServoT]] = {}
        for name in config.buses:
            fitted = [entry for entry in config.servos if config.bus_of(entry) == name]
            for entry in fitted:
                self._servos[entry.joint] = self._servo(entry, shaft(config, entry, angles[entry.joint]))
            ids = {entry.joint: entry.id for entry in fitted}
            wire = WireFaults.asked(faults, self.kinds, ids, self._rng)
            self.chains[name] = self._chain([self._servos[joint] for joint in ids], wire)
        for fault in faults:
            if fault.joint in self._servos:
                self._begin(fault.kind, fault.joint)

    @abstractmethod
    def _servo(self, entry: ServoConfig, angle: Angle) -> ServoT:
        """The servo of an entry, its shaft at `angle`."""

    @abstractmethod
    def _chain(self, servos: Sequence[ServoT], faults: Faults) -> ServoChain[ServoT]:
        """The servos of a bus."""

    @abstractmethod
    def _change_rate(self, servo: ServoT) -> None:
        """Let the servo listen at another rate."""

    @property
    def devices(self) -> Mapping[str, ServoChain[ServoT]]:
        """What is behind each port, by name of the bus."""
        return self.chains

    @property
    def count(self) -> int:
        """How many packets the servos understood."""
        return sum(chain.instructions for chain in self.chains.values())

    def servo(self, joint: str) -> ServoT:
        """The servo of a joint."""
        return self._servos[joint]

    def at_ports(self, ports: Mapping[str, str]) -> ConfigT:
        """The configuration with other ports, by name of the bus."""
        buses = {name: msgspec.structs.replace(bus, port=ports[name]) for name, bus in self._config.buses.items()}
        return msgspec.structs.replace(self._config, buses=buses)

    def glitch(self, joint: str, is_wrong: bool) -> None:
        """A joint's encoder begins or ends to be wrong."""
        self._servos[joint].glitch_ticks = GLITCH_TICKS if is_wrong else 0

    def power_cycle(self, t: float) -> None:
        """All lose their power and get it back at `t`."""
        for chain in self.chains.values():
            chain.power_cycle(t)

    def _begin(self, kind: str, joint: str) -> None:
        """What is another way from the beginning."""
        servo = self._servos[joint]
        if kind in self.errors:
            servo.fail(self.errors[kind])
        elif kind == "baud":
            self._change_rate(servo)
        elif kind == "double":
            entry = next(entry for entry in self._config.servos if entry.joint == joint)
            self.chains[self._config.bus_of(entry)].servos.append(self._servo(entry, lambda _: TWIN_RAD))
        elif kind == "torque":
            servo["torque"] = 1


def shaft(config: ServosConfig[Any], entry: ServoConfig, angle: Angle) -> Angle:
    """The shaft's angle [rad], which is 0 in the middle of the servo's range, from that of the joint."""
    model = config.model_of(entry)
    zero = model.zero_ticks if entry.zero_ticks is None else entry.zero_ticks
    shift = (zero - model.zero_ticks) * model.rad_per_tick
    return lambda t: entry.direction * angle(t) + shift
