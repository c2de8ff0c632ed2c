"""Emulate one Feetech servo: its control table and the rules by which it changes."""

from __future__ import annotations

import math

from bodyschema.drivers.emulator.chain import EmulatedServo
from bodyschema.drivers.emulator.device import Angle
from bodyschema.drivers.feetech.models import BAUDS, SCS
from bodyschema.drivers.servos.model import Model

RETURN_DELAY_UNIT_US = 2
CALIBRATE = 128  # written to the torque register: makes the present position the middle of the range
FACTORY = {"firmware": 0x030A, "baud": 0, "id": 1, "return_delay": 250, "status_return": 1}
RAM_OF_FACTORY = {"lock": 1, "voltage": 74, "temperature": 31}
# Other EEPROM values of a new servo: address, bytes, number. Sources: Feetech, "SMS/STS memory table"; gains and
# protection current: defaults named by huggingface/lerobot (robots/so_follower); voltage limits:
# Mickael-Roger/python-st3215 for the 7.4 V variant.
FACTORY_STS = (
    (9, 2, 0),  # position limits [ticks]
    (11, 2, 4095),
    (13, 1, 70),  # temperature [°C]
    (14, 1, 80),  # voltages [0.1 V]
    (15, 1, 40),
    (16, 2, 1000),  # torque [0.1 %]
    (18, 1, 12),  # Phase
    (19, 1, 44),  # troubles that switch torque off: overload, current, temperature
    (20, 1, 47),  # ... and the LED on
    (21, 1, 32),  # P, D, I
    (22, 1, 32),
    (23, 1, 0),
    (24, 2, 16),  # least torque at the start [0.1 %]
    (26, 1, 1),  # dead zones [ticks]
    (27, 1, 1),
    (28, 2, 500),  # current [6.5 mA]
    (30, 1, 1),  # resolution
    (34, 1, 20),  # overload: torque then [%], after [10 ms], above [%]
    (35, 1, 200),
    (36, 1, 80),
    (38, 1, 200),  # too much current: after [10 ms]
)
# Source: Feetech, "SCS15 manual" v1.02, memory control table.
FACTORY_SCS = (
    (9, 2, 0),
    (11, 2, 1023),
    (13, 1, 80),
    (14, 1, 250),
    (15, 1, 50),
    (16, 2, 1023),
    (19, 1, 37),
    (20, 1, 37),
    (21, 1, 15),
    (26, 1, 2),
    (27, 1, 2),
)
MAX_TORQUE, TORQUE_LIMIT = 16, 48  # at power-up the two bytes of the first are copied to the second
READ_ONLY = ("firmware", "model", "position", "velocity", "load", "voltage", "temperature", "status", "moving")
LARGEST_SPEED = 3400  # [ticks/s]


class Servo(EmulatedServo):
    """An emulated servo. Torque has no effect on the shaft."""

    delay_unit_us = RETURN_DELAY_UNIT_US

    def __init__(
        self,
        model: Model,
        id: int,
        angle: Angle,
        *,
        baud: int = 1_000_000,
        return_delay_s: float = 500e-6,  # delay between instruction and answer
        multi_turn: bool = False,  # it counts turns until it loses power
    ) -> None:
        """Create a servo with factory settings, except for the arguments."""
        super().__init__(model, angle)
        self.knows_sync_read = model.protocol != SCS  # it answers SYNC_READ
        self._multi_turn, self._base = multi_turn, 0
        self["model"] = model.number
        self._set_factory_values()
        for name, value in RAM_OF_FACTORY.items():
            self[name] = value
        self["id"], self["baud"] = id, BAUDS.index(baud)
        self["return_delay"] = round(return_delay_s * 1e6 / RETURN_DELAY_UNIT_US)
        self._saved = bytes(self._memory[: model.layout.ram])
        self._power_up()

    def __getitem__(self, name: str) -> int:
        register = self.model.layout.registers.get(name)
        return 0 if register is None else register.value(bytes(self._memory[register.address : register.end]))

    def __setitem__(self, name: str, value: int) -> None:
        register = self.model.layout[name]
        self._memory[register.address : register.end] = register.bytes(value)
        self._saved = bytes(self._memory[: self.model.layout.ram])

    @property
    def baud(self) -> int:
        return BAUDS[min(self["baud"], len(BAUDS) - 1)]

    def fail(self, bits: int) -> None:
        """Report a hardware error until the servo is rebooted. Torque goes off if `unloading` includes it."""
        self["status"] |= bits
        if bits & self["unloading"]:
            self["torque"] = 0

    def reboot(self, t: float) -> None:
        """Restart as after a power cycle: RAM, writes to a locked EEPROM, and the number of turns are lost."""
        ram = self.model.layout.ram
        self._memory[:] = self._saved + bytes(len(self._memory) - ram)
        for name, value in RAM_OF_FACTORY.items():
            self[name] = value
        self._power_up()
        self._registered = None
        self._base = math.floor(self._count(t) / (self.model.ticks_per_turn or 1))

    def position(self, t: float) -> int:
        """Return Present Position at `t` [ticks]."""
        counted, turn = self._count(t) + self.glitch_ticks, self.model.ticks_per_turn
        if turn is None:
            return min(max(counted, 0), 1023)
        return counted - self._base * turn if self._multi_turn else counted % turn

    def read(self, address: int, size: int, t: float) -> bytes | None:
        """Read bytes of the control table at `t`; None if the address range is invalid."""
        if size == 0 or address + size > len(self._memory):
            return None
        self._sense(t)
        return bytes(self._memory[address : address + size])

    def write(self, address: int, data: bytes, t: float) -> None:
        """Write bytes of the control table; read-only registers keep their values."""
        layout = self.model.layout
        fixed = {place for name in READ_ONLY for place in range(layout[name].address, layout[name].end)}
        for place, byte in enumerate(data, address):
            if place < len(self._memory) and place not in fixed:
                self._memory[place] = byte
        if not self["lock"]:
            self._saved = bytes(self._memory[: layout.ram])
        if self["torque"] == CALIBRATE:
            self._calibrate(t)

    def register_write(self, address: int, data: bytes) -> None:
        """Store a write for ACTION."""
        self._registered = (address, data)

    def action(self, t: float) -> None:
        """Execute the stored write."""
        if self._registered is not None:
            self.write(*self._registered, t)
        self._registered = None

    def factory_reset(self, t: float) -> None:
        """Restore all factory values except the ID."""
        id = self.id
        self._set_factory_values()
        self["id"] = id
        self.reboot(t)

    def _set_factory_values(self) -> None:
        model = self.model
        for address, size, value in FACTORY_STS if model.protocol != SCS else FACTORY_SCS:
            self._memory[address : address + size] = value.to_bytes(size, model.layout["model"].order)
        for name, value in FACTORY.items():
            self[name] = value

    def _power_up(self) -> None:
        if self.model.protocol != SCS:
            self._memory[TORQUE_LIMIT : TORQUE_LIMIT + 2] = self._memory[MAX_TORQUE : MAX_TORQUE + 2]

    def _calibrate(self, t: float) -> None:
        self["torque"] = 0
        if "homing_offset" in self.model.layout:
            offset = self._count(t) + self["homing_offset"] - self.model.zero_ticks
            self["homing_offset"] = (offset + 2047) % 4096 - 2047

    def _count(self, t: float) -> int:
        ticks = round(self._angle(t) / self.model.rad_per_tick) + self.model.zero_ticks
        return ticks - self["homing_offset"]

    def _sense(self, t: float, step_s: float = 0.01) -> None:
        """Write the measured values at `t` into the control table."""
        layout = self.model.layout
        rad_s = (self._angle(t) - self._angle(t - step_s)) / step_s
        velocity = round(rad_s / self.model.velocity_unit)
        measured = {
            "velocity": min(max(velocity, -LARGEST_SPEED), LARGEST_SPEED),
            "moving": int(velocity != 0),
            "position": self.position(t),
        }
        for name, value in measured.items():
            register = layout[name]
            self._memory[register.address : register.end] = register.bytes(value)
