"""How a model of servo is described."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal


@dataclass(frozen=True, slots=True)
class Register:
    """Some bytes of a control table.

    Attributes:
        signed: two's complement.
        sign_bit: the bit that tells the sign where the rest is the magnitude.
        order: of the bytes.
    """

    address: int
    size: int
    signed: bool = False
    sign_bit: int | None = None
    order: Literal["little", "big"] = "little"

    def value(self, data: bytes) -> int:
        """The number in the register's bytes."""
        number = int.from_bytes(data, self.order, signed=self.signed)
        if self.sign_bit is None:
            return number
        magnitude = number & ((1 << self.sign_bit) - 1)
        return -magnitude if number >> self.sign_bit & 1 else magnitude

    def bytes(self, value: int) -> bytes:
        """The register's bytes for a number."""
        if self.sign_bit is not None:
            value = abs(value) | (1 << self.sign_bit if value < 0 else 0)
        return value.to_bytes(self.size, self.order, signed=self.signed)

    def words(self, table: bytes) -> str:
        """The register's bytes in a control table from its beginning, each as a number, as versions are written."""
        return ".".join(map(str, table[self.address : self.end]))

    @property
    def end(self) -> int:
        """The address after the last byte."""
        return self.address + self.size


@dataclass(frozen=True, slots=True)
class Layout:
    """Where a series keeps what.

    Attributes:
        protocol: the version of its make's protocol.
        registers: by name; the same names in all series.
        block: what one reading asks for: the position, and what tells whether to believe it.
        state: begins with torque; has hardware_error in it where that is a register and not the error byte.
        ram: address of the first register that is lost with the power and never locked.
        size: bytes of the control table.
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
        """The number in a register; `data` is what stands from `address` on. 0 where there is no such register."""
        if name not in self.registers:
            return 0
        register = self.registers[name]
        return register.value(data[register.address - address : register.end - address])


@dataclass(frozen=True, slots=True)
class Model:
    """One kind of servo.

    Attributes:
        rad_per_tick: exactly a turn, or the sensed part of it, by its number of ticks [rad].
        ticks_per_turn: None where the sensor does not turn on.
        zero_ticks: the position that its manual calls 0°, in the middle of the range.
        velocity_unit: of the register [rad/s].
        current_unit: of the register [A]; None where there is no such sensor (the register then shows the load).
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
        """The version of its make's protocol that it speaks."""
        return self.layout.protocol


def no_driver(name: str) -> str:
    """What to say of a model that is known, and that no driver reads."""
    return f"no driver reads an {name}: its control table is not that of other servos. Take another model"
