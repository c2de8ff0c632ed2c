"""Reported state of servos and buses."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from .channel import Sample
from .handshake import Finding, FittedServo
from .model import Model, Register

log = logging.getLogger(__name__)

VOLT_PER_UNIT = 0.1  # for all series of all vendors; temperatures are in °C


@dataclass(frozen=True, slots=True)
class ServoHealth:
    """State of one servo.

    Attributes:
        homing_offset, drive_mode: as stored in its EEPROM.
        voltage_v, temperature_c: last reported; None before.
        current_a: None where it is not measured.
        troubles: what is wrong with it, and what to do.
    """

    joint: str
    bus: str
    id: int
    model: str
    firmware: int
    homing_offset: int
    drive_mode: int
    voltage_v: float | None
    temperature_c: float | None
    current_a: float | None
    troubles: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class BusHealth:
    """Statistics of one bus since the start.

    Attributes:
        exchanges: number of requests.
        troubles: number of failed requests, by kind of failure.
        way: read method of its servos; empty before the first opening.
    """

    exchanges: int
    troubles: Mapping[str, int]
    way: str


class Health:
    """State of the servos of an arm.

    Attributes:
        away: names of the buses whose ports cannot be opened.
    """

    def __init__(self, errors: Mapping[int, str]) -> None:
        """Start without reports.

        Args:
            errors: meaning and remedy of each bit of the hardware error.
        """
        self._errors = errors
        self._alerts: dict[str, int] = {}
        self._supplies: dict[str, tuple[float, float]] = {}
        self._absent: dict[str, str] = {}
        self.away: set[str] = set()

    @property
    def complaints(self) -> tuple[str, ...]:
        """Current problems of servos, and what to do."""
        return tuple(f"joint {joint!r}: {'; '.join(self._reasons(bits))}" for joint, bits in list(self._alerts.items()))

    def knows_supply(self, joint: str) -> bool:
        """Return True if the voltage and temperature of the joint's servo are known."""
        return joint in self._supplies

    def note_alert(self, joint: str, bits: int) -> None:
        """Update the hardware error bits of a servo, and log changes."""
        if self._alerts.get(joint, 0) == bits:
            return
        if bits:
            self._alerts[joint] = bits
            log.warning("joint %r: %s", joint, "; ".join(self._reasons(bits)))
        else:
            del self._alerts[joint]
            log.info("joint %r is well again", joint)

    def note_supply(self, joint: str, model: Model, data: bytes) -> None:
        """Update voltage and temperature from the registers of `supply_of`."""
        first = supply_of(model).address
        voltage = VOLT_PER_UNIT * model.layout.value("voltage", data, first)
        self._supplies[joint] = (voltage, float(model.layout.value("temperature", data, first)))

    def note_found(self, findings: Iterable[Finding]) -> None:
        """Note which servos were found at an opening, and which were not."""
        self._absent = {finding.config.joint: finding.found for finding in findings if finding.servo is None}

    def note_silent(self, joint: str, trouble: str) -> None:
        """Note that a servo does not answer when it is asked alone."""
        self._absent[joint] = trouble

    def of(self, servo: FittedServo, sample: Sample | None, lost: str | None) -> ServoHealth:
        """Return the state of a servo; `lost` is the joint that lost its turn count."""
        joint = servo.joint
        voltage, temperature = self._supplies.get(joint, (None, None))
        troubles = self._reasons(self._alerts.get(joint, 0))
        if joint == lost:
            troubles.append("its turn count is lost: turn it back, or say that it is right")
        if joint in self._absent:
            troubles = [f"{self._absent[joint]}: look at its supply and cable, and those of the one before it"]
        if servo.bus in self.away:
            troubles = ["its bus is away: look at the adapter's cable"]
        current = None if sample is None else sample.current
        about = (joint, servo.bus, servo.id, servo.model.name, servo.firmware, servo.homing_offset, servo.drive_mode)
        return ServoHealth(*about, voltage, temperature, current, tuple(troubles))

    def _reasons(self, bits: int) -> list[str]:
        known = [text for bit, text in self._errors.items() if bits & bit]
        return known or ([f"hardware error {bits:#04x}"] if bits else [])


def supply_of(model: Model) -> Register:
    """Return the register range with voltage and temperature of a model."""
    voltage, temperature = model.layout["voltage"], model.layout["temperature"]
    return Register(voltage.address, temperature.end - voltage.address)
