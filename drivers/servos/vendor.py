"""Properties of a servo vendor that the common driver needs."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from bodyschema.drivers.servos.bus import Bus, Request

from .channel import Channel
from .config import ServosConfig
from .handshake import HandshakeSettings
from .model import Model
from .servo import IdentifiedServo
from .settings import Setting


@dataclass(frozen=True, slots=True)
class ReadMethod:
    """One method of reading a group of servos."""

    name: str  # for messages
    requests: tuple[Request, ...]
    # what is wrong when the group fails to answer, though all its servos support it; None: some may not
    complaint: str | None = None


class ReadPlan:
    """The fastest read method that works, for each group of servos of a bus."""

    def __init__(self, bus: Bus, groups: Sequence[Sequence[ReadMethod]]) -> None:
        """Try each group's methods, the fastest first, several times each. The last one is taken without a try."""
        self._bus, self._groups = bus, groups
        self._selected = [self._first_answered(read_methods, HandshakeSettings.attempts) for read_methods in groups]

    @property
    def requests(self) -> list[Request]:
        """The requests of one reading."""
        return [request for method in self._methods for request in method.requests]

    @property
    def name(self) -> str:
        """Names of the methods in use."""
        return ", ".join(dict.fromkeys(method.name for method in self._methods))

    @property
    def complaints(self) -> list[str]:
        """Problems of groups that are read with a slower method than they support."""
        slower = [
            method
            for read_methods, selected in zip(self._groups, self._selected, strict=True)
            for method in read_methods[:selected]
        ]
        return [method.complaint for method in slower if method.complaint is not None]

    def improve(self) -> bool:
        """Try the faster methods of each group once. Return True if one is used from now on."""
        before = self._selected
        pairs = zip(self._groups, self._selected, strict=True)
        self._selected = [self._first_answered(read_methods[: selected + 1], 1) for read_methods, selected in pairs]
        return self._selected != before

    @property
    def _methods(self) -> list[ReadMethod]:
        return [read_methods[selected] for read_methods, selected in zip(self._groups, self._selected, strict=True)]

    def _first_answered(self, read_methods: Sequence[ReadMethod], attempts: int) -> int:
        for place, method in enumerate(read_methods[:-1]):
            for _ in range(attempts):
                if all(self._bus.ask(request).trouble is None for request in method.requests):
                    return place
        return len(read_methods) - 1


def one_by_one(bus: Bus, servos: Sequence[IdentifiedServo]) -> ReadMethod:
    """Return the method that reads each servo by itself."""
    requests = (bus.read_request(servo.model, servo.id, servo.model.layout.block) for servo in servos)
    return ReadMethod("one by one", tuple(requests))


@dataclass(frozen=True, slots=True)
class ServoVendor:
    table: str  # its table in [drivers]
    models: Mapping[int, Model] = field(repr=False)  # by number
    errors: Mapping[int, str]  # meaning and remedy of each bit of the hardware error
    bus: type[Bus]  # class of its buses
    channel: Callable[[IdentifiedServo], Channel]  # creates the decoder of one servo's answers
    # returns the read methods of each group of servos on a bus, the fastest first
    read_methods: Callable[[Bus, Sequence[IdentifiedServo], Any], Sequence[Sequence[ReadMethod]]]
    settings: Callable[[Model], Sequence[Setting]]  # returns the EEPROM settings of a model that a command may change
    # 1 where the homing offset is added to the sensor's value, −1 where it is subtracted
    homing_sign: Literal[1, -1] = 1
    tick_s: float = 0.0  # tick of the clock with which servos stamp their measurements [s]; 0 without one


def plans_of(
    vendor: ServoVendor, buses: Mapping[str, Bus], servos: Sequence[IdentifiedServo], config: ServosConfig[Any]
) -> dict[str, ReadPlan]:
    """Return the read methods of each bus, by name of the bus."""
    return {
        name: ReadPlan(
            bus, vendor.read_methods(bus, [servo for servo in servos if servo.bus == name], config.buses[name])
        )
        for name, bus in buses.items()
    }
