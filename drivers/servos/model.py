"""Description of a servo model."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from .packets import Status


@dataclass(frozen=True, slots=True)
class Register:
    """A byte range of a control table.

    Attributes:
        signed: two's complement.
        sign_bit: index of the sign bit, if the other bits are the magnitude.
        order: byte order.
    """

    address: int
    size: int
    signed: bool = False
    sign_bit: int | None = None
    order: Literal["little", "big"] = "little"

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
    """Register addresses of a series.

    Attributes:
        protocol: version of the vendor's protocol.
        registers: by name; the same names in all series.
        block: range of one reading: the position and the values that validate it.
        state: range that begins with torque and includes hardware_error, if that is a register and not the error byte.
        ram: address of the first register that is volatile and never locked.
        size: of the control table [bytes].
    """

    protocol: int
    registers: Mapping[str, Register] = field(repr=False)
    block: Register
    state: Register
    ram: int
    size: int

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
    """One model of servo.

    Attributes:
        number: its model number.
        name: as its maker writes it.
        series: the series it belongs to.
        layout: its register addresses.
        rad_per_tick: a turn, or the measured range, divided by its number of ticks [rad].
        ticks_per_turn: None for a sensor that does not wrap.
        zero_ticks: the position that its manual calls 0°, in the middle of the range.
        velocity_unit: of the register [rad/s].
        current_unit: of the register [A]; None without such a sensor (the register then shows the load).
    """

    number: int
    name: str
    series: str
    layout: Layout
    rad_per_tick: float
    ticks_per_turn: int | None
    zero_ticks: int
    velocity_unit: float
    current_unit: float | None

    @property
    def protocol(self) -> int:
        """Version of the vendor's protocol that it speaks."""
        return self.layout.protocol


def no_driver(name: str) -> str:
    """Return the message for a known model without a driver."""
    return f"no driver reads an {name}: its control table is not that of other servos. Take another model"
