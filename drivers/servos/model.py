"""Description of a servo model."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from .packets import Status


@dataclass(frozen=True, slots=True)
class Register:
    """A byte range of a control table."""

    address: int
    size: int
    signed: bool = False  # two's complement
    sign_bit: int | None = None  # index of the sign bit, if the other bits are the magnitude
    order: Literal["little", "big"] = "little"  # byte order

    def value(self, data: bytes) -> int:
        """Return the number in the register's bytes."""
        number = int.from_bytes(data, self.order, signed=self.signed)
        if self.sign_bit is None:
            return number
        magnitude = number & ((1 << self.sign_bit) - 1)
        return -magnitude if number >> self.sign_bit & 1 else magnitude

    def bytes(self, value: int) -> bytes:
        """Return the register's bytes for a number."""
        if self.sign_bit is not None:
            value = abs(value) | (1 << self.sign_bit if value < 0 else 0)
        return value.to_bytes(self.size, self.order, signed=self.signed)

    def words(self, table: bytes) -> str:
        """Return the register's bytes in a control table, given from its start, as a dotted version number."""
        return ".".join(map(str, table[self.address : self.end]))

    @property
    def end(self) -> int:
        """The address after the last byte."""
        return self.address + self.size


@dataclass(frozen=True, slots=True)
class Layout:
    """Register addresses of a series."""

    protocol: int  # version of the vendor's protocol
    registers: Mapping[str, Register] = field(repr=False)  # by name; the same names in all series
    block: Register  # range of one reading: the position and the values that validate it
    # range that begins with torque and includes hardware_error, if that is a register and not the error byte
    state: Register
    ram: int  # address of the first register that is volatile and never locked
    size: int  # of the control table [bytes]

    def __getitem__(self, name: str) -> Register:
        return self.registers[name]

    def __contains__(self, name: str) -> bool:
        return name in self.registers

    def value(self, name: str, data: bytes, address: int = 0) -> int:
        """Return the number in a register, or 0 if there is no such register; `data` begins at `address`."""
        if name not in self.registers:
            return 0
        register = self.registers[name]
        return register.value(data[register.address - address : register.end - address])

    def torque_and_errors(self, status: Status) -> tuple[int, int]:
        """Return the torque flag and the hardware error bits in an answer that begins with `state`."""
        begin = self.state.address
        has_register = "hardware_error" in self
        bits = self.value("hardware_error", status.data, begin) if has_register else status.error
        return self.value("torque", status.data, begin), bits


@dataclass(frozen=True, slots=True)
class Model:
    number: int  # its model number
    name: str  # as its maker writes it
    series: str  # the series it belongs to
    layout: Layout  # its register addresses
    rad_per_tick: float  # a turn, or the measured range, divided by its number of ticks [rad]
    ticks_per_turn: int | None  # None for a sensor that does not wrap
    zero_ticks: int  # the position that its manual calls 0°, in the middle of the range
    velocity_unit: float  # of the register [rad/s]
    current_unit: float | None  # of the register [A]; None without such a sensor (the register then shows the load)

    @property
    def protocol(self) -> int:
        """Version of the vendor's protocol that the model uses."""
        return self.layout.protocol


def no_driver(name: str) -> str:
    """Return the message for a known model without a driver."""
    return f"no driver reads an {name}: its control table is not that of other servos. Take another model"
