"""A servo of the arm with its settings; convert ticks to the joint's angle and back."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from .model import Model


@dataclass(frozen=True, slots=True)
class IdentifiedServo:
    joint: str  # whose angle it tells
    bus: str  # the name of its bus
    id: int
    model: Model
    # direction, zero_ticks: from its position to the joint's angle
    direction: int
    zero_ticks: int | float
    # firmware, drive_mode, operating_mode, homing_offset, return_delay_s: as its control table says; a change of them
    # between two recordings is a change of calibration
    firmware: int
    drive_mode: int
    operating_mode: int
    homing_offset: int
    return_delay_s: float
    had_torque: bool = False  # its torque was on

    @property
    def version(self) -> str:
        """Firmware version in the vendor's notation."""
        return ".".join(map(str, self.model.layout["firmware"].bytes(self.firmware)))

    @property
    def label(self) -> str:
        """ID of the servo, for messages."""
        return f"ID {self.id}"

    @property
    def ticks_per_turn(self) -> int | None:
        """Ticks after which the sensor's position repeats; None if it does not wrap around."""
        return self.model.ticks_per_turn

    def angle(self, ticks: int) -> float:
        """Return the joint angle [rad] at a multi-turn position [ticks]."""
        return self.direction * (ticks - self.zero_ticks) * self.model.rad_per_tick

    def ticks(self, angle: float) -> float:
        """Return the multi-turn position [ticks] at a joint angle [rad]."""
        return self.zero_ticks + self.direction * angle / self.model.rad_per_tick

    def record(self) -> Mapping[str, object]:
        """Return the servo's identity and settings, to be kept with the data."""
        return {
            "joint": self.joint,
            "bus": self.bus,
            "id": self.id,
            "model": self.model.name,
            "firmware": self.firmware,
            "drive_mode": self.drive_mode,
            "operating_mode": self.operating_mode,
            "homing_offset_ticks": self.homing_offset,
            "zero_ticks": self.zero_ticks,
            "direction": self.direction,
            "rad_per_tick": self.model.rad_per_tick,
            "return_delay_s": self.return_delay_s,
        }
