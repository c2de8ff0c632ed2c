"""Emulate the servos of a robot.toml."""

from __future__ import annotations

import math
import time
from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from random import Random
from typing import Any, ClassVar, Generic, TypeVar

import msgspec
import numpy as np

from bodyschema.drivers.servos.config import ServoConfig, ServosConfig
from bodyschema.interfaces.records import FloatArray, frozen_array

from .chain import ServoChain, ServoT
from .device import Angle, Faults
from .dry_run import GLITCH_TICKS, DryRunArm
from .faults import FaultKinds, FaultSpec, WireFaults


class _Settings:
    # period of the slowest swing
    slowest_s: float = 20.0
    # between neighbours: the golden angle, so that no two joints move together
    phase_rad: float = 2.4
    widest_rad: float = 1.0
    share_of_range: float = 0.35
    # shaft angle of a second servo with the same ID
    twin_rad: float = 0.1


def played(path: FloatArray, rate_hz: float, begin_s: float) -> list[Angle]:
    """Return for each joint a function of time that plays the path forwards and backwards forever.

    Args:
        path: angles [rad], shape (n, d) with n > 1.
    """
    path = frozen_array(path)
    rows = np.arange(len(path), dtype=np.float64)
    last = len(path) - 1

    def joint(column: FloatArray) -> Angle:
        return lambda t: float(np.interp(last - abs((t - begin_s) * rate_hz % (2 * last) - last), rows, column))

    return [joint(np.ascontiguousarray(path[:, k])) for k in range(path.shape[1])]


def swinging(limits: Sequence[tuple[float, float]], begin_s: float) -> list[Angle]:
    """Return for each joint a slow swing around the middle of its range [rad]."""

    def joint(place: int, lower: float, upper: float) -> Angle:
        bounded = math.isfinite(lower) and math.isfinite(upper)
        middle = (lower + upper) / 2 if bounded else 0.0
        width = min(_Settings.share_of_range * (upper - lower), _Settings.widest_rad)  # infinite where not bounded
        pace = 2 * math.pi / (_Settings.slowest_s * (0.6 + 0.4 / (place + 1)))
        return lambda t: middle + width * math.sin(pace * (t - begin_s) + _Settings.phase_rad * place)

    return [joint(place, lower, upper) for place, (lower, upper) in enumerate(limits)]


AT_THE_START = ("baud", "double", "torque")


ConfigT = TypeVar("ConfigT", bound=ServosConfig[Any])


class ServoArm(DryRunArm, Generic[ServoT, ConfigT]):
    """Servos as configured, one chain per bus."""

    unit: ClassVar[str] = "packets understood"
    kinds: ClassVar[FaultKinds]
    errors: ClassVar[Mapping[str, int]]
    """Bits of what is wrong with a servo, by the names of the faults."""

    def __init__(
        self,
        config: ConfigT,
        angles: Mapping[str, Angle],  # by joint, its angle as a function of time [rad]
        *,
        faults: Sequence[FaultSpec] = (),
        return_delay_s: float = 0.0,
        seed: int = 0,
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        self._config, self._return_delay_s, self._rng, self._now = config, return_delay_s, Random(seed), now
        self._servos: dict[str, ServoT] = {}
        self.chains: dict[str, ServoChain[ServoT]] = {}  # by name of the bus
        for name in config.buses:
            fitted = [entry for entry in config.servos if config.bus_of(entry) == name]
            for entry in fitted:
                self._servos[entry.joint] = self._servo(entry, shaft(config, entry, angles[entry.joint]))
            ids = {entry.joint: entry.id for entry in fitted}
            wire = WireFaults.requested(faults, self.kinds, ids, self._rng)
            self.chains[name] = self._chain([self._servos[joint] for joint in ids], wire)
        for fault in faults:
            if fault.joint in self._servos:
                self._begin(fault.kind, fault.joint)

    @abstractmethod
    def _servo(self, entry: ServoConfig, angle: Angle) -> ServoT:
        """Create the servo of an entry, its shaft at `angle`."""

    @abstractmethod
    def _chain(self, servos: Sequence[ServoT], faults: Faults) -> ServoChain[ServoT]:
        """Create the chain of a bus."""

    @abstractmethod
    def _change_rate(self, servo: ServoT) -> None:
        """Set the servo to another baud rate."""

    @property
    def devices(self) -> Mapping[str, ServoChain[ServoT]]:
        return self.chains

    @property
    def count(self) -> int:
        return sum(chain.instructions for chain in self.chains.values())

    def servo(self, joint: str) -> ServoT:
        return self._servos[joint]

    def at_ports(self, ports: Mapping[str, str]) -> ConfigT:
        buses = {name: msgspec.structs.replace(bus, port=ports[name]) for name, bus in self._config.buses.items()}
        return msgspec.structs.replace(self._config, buses=buses)

    def glitch(self, joint: str, is_wrong: bool) -> None:
        self._servos[joint].glitch_ticks = GLITCH_TICKS if is_wrong else 0

    def power_cycle(self, t: float) -> None:
        for chain in self.chains.values():
            chain.power_cycle(t)

    def _begin(self, kind: str, joint: str) -> None:
        """Apply a fault that is present from the start."""
        servo = self._servos[joint]
        if kind in self.errors:
            servo.fail(self.errors[kind])
        elif kind == "baud":
            self._change_rate(servo)
        elif kind == "double":
            entry = next(entry for entry in self._config.servos if entry.joint == joint)
            self.chains[self._config.bus_of(entry)].servos.append(self._servo(entry, lambda _: _Settings.twin_rad))
        elif kind == "torque":
            servo["torque"] = 1


def shaft(config: ServosConfig[Any], entry: ServoConfig, angle: Angle) -> Angle:
    """Convert the joint's angle to the shaft's angle [rad], which is 0 in the middle of the servo's range."""
    model = config.model_of(entry)
    zero = model.zero_ticks if entry.zero_ticks is None else entry.zero_ticks
    shift = (zero - model.zero_ticks) * model.rad_per_tick
    return lambda t: entry.direction * angle(t) + shift
