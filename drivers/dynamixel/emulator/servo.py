"""Emulate one Dynamixel servo: its control table and the rules by which it changes."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from bodyschema.drivers.dynamixel.models import TICK_S, TICKS, Model, baud_of, baud_value
from bodyschema.drivers.emulator.chain import EmulatedServo
from bodyschema.drivers.emulator.device import Angle

from .factory import factory_values, indirect_blocks
from .frames import Error

CURRENT_MODE, POSITION_MODE = 0, 3  # Operating Mode
MODES_WITH_CURRENT, MODES_WITHOUT = (0, 1, 3, 4, 5, 16), (1, 3, 4, 16)
GOALS = ("goal_current", "goal")
WATCHDOG_UNIT_S = 0.02
FIRED = -1  # Bus Watchdog
REVERSE = 0x01  # Drive Mode
TICKS_PER_REPLY_DELAY_US = 2

_COMMON = {"id": 1, "baud": 1, "return_delay": 250, "status_return": 2, "temperature": 31}
FACTORY2 = _COMMON | {"firmware": 46, "operating_mode": POSITION_MODE}
FACTORY1 = _COMMON | {"firmware": 24, "shutdown": 36}
READ_ONLY = (
    "model",
    "firmware",
    "hardware_error",
    "voltage",
    "temperature",
    "moving",
    "position",
    "velocity",
    "current",
)
LARGEST = {"id": 252, "torque": 1, "status_return": 2, "return_delay": 254}
JUDGED = (*LARGEST, *GOALS, "operating_mode")
RAM_OF_FACTORY = ("status_return", "temperature")


class Servo(EmulatedServo):
    """An emulated servo.

    Its action on the shaft is available as `motor_current` and `held_at`: an `angle` that follows these moves as a real
    arm would.

    Attributes:
        excess_a: current drawn above the regulated one [A].
        fast: True if it supports FAST_SYNC_READ.
    """

    delay_unit_us = TICKS_PER_REPLY_DELAY_US

    def __init__(
        self,
        model: Model,
        id: int,
        angle: Angle,
        *,
        baud: int = 1_000_000,
        return_delay_s: float = 500e-6,
        booted_s: float = 0.0,
        fast: bool = True,
    ) -> None:
        """Create a servo with factory settings, except for the arguments."""
        super().__init__(model, angle)
        self.fast, self.excess_a = fast, 0.0
        self._values: dict[str, int] = {}  # of registers, as far as they have been read since the memory changed
        self._is_protocol2 = model.protocol == 2
        self._places = {name: (r.address, r.end, r.signed) for name, r in model.layout.registers.items()}
        self._indirect = {
            data + k: pointer + 2 * k for pointer, data, count in indirect_blocks(model) for k in range(count)
        }
        self._read_only = [self._places[name][:2] for name in READ_ONLY if name in self._places]
        self._judged = [name for name in JUDGED if name in self._places]
        self._pointers = frozenset(self._indirect.values())
        self._first_indirect = min(self._indirect, default=len(self._memory))
        self._reset_memory()
        self["id"], self["baud"] = id, baud_value(model.layout, baud)
        self["return_delay"] = round(return_delay_s * 1e6 / TICKS_PER_REPLY_DELAY_US)
        self._booted_s = booted_s
        self._base = 0
        self._heard_s = booted_s
        self._held_at: float | None = None
        self._fold(booted_s)

    def __getitem__(self, name: str) -> int:
        value = self._values.get(name)
        if value is None:
            address, end, signed = self._places[name]
            value = self._values[name] = int.from_bytes(self._memory[address:end], "little", signed=signed)
        return value

    def __setitem__(self, name: str, value: int) -> None:
        address, end, signed = self._places[name]
        self._memory[address:end] = value.to_bytes(end - address, "little", signed=signed)
        self._values[name] = value

    @property
    def baud(self) -> int:
        return baud_of(self.model.layout, self["baud"])

    @property
    def hardware_error(self) -> int:
        return self._error1 if self.model.protocol == 1 else self["hardware_error"]

    def fail(self, bits: int) -> None:
        """Report a hardware error until the servo is rebooted. Torque goes off if `shutdown` includes it."""
        if self.model.protocol == 1:
            self._error1 |= bits
        else:
            self["hardware_error"] |= bits
        if bits & self["shutdown"]:
            self["torque"] = 0

    def hear(self, t: float) -> None:
        """Note that an instruction for the servo arrived at `t`."""
        self._look_at_watchdog(t)
        self._heard_s = t

    def motor_current(self, t: float) -> float:
        """Return the regulated motor current at `t` [A], positive if it turns the shaft forward; 0 in other modes."""
        self._look_at_watchdog(t)
        unit = self.model.current_unit
        if unit is None or not self["torque"] or self["watchdog"] == FIRED:
            return 0.0
        if self["operating_mode"] != CURRENT_MODE:
            return 0.0
        return (-1 if self._is_reversed else 1) * self["goal_current"] * unit

    def held_at(self, t: float) -> float | None:
        """Return the shaft angle that the servo moves to and holds [rad]; None if it holds nothing."""
        self._look_at_watchdog(t)
        if not self["torque"] or not self._is_in_position_mode:
            return None
        if self["watchdog"] == FIRED:
            return self._held_at
        ticks = self["goal"] + self._base - self["homing_offset"]
        return ((-ticks if self._is_reversed else ticks) - self.model.zero_ticks) * self.model.rad_per_tick

    def _look_at_watchdog(self, t: float) -> None:
        """Stop the servo if no instruction arrived for too long (e-Manual, Bus Watchdog).

        It then accepts no further goals. The shaft is free in current control, and held in place in position control.
        """
        if not self._is_protocol2 or (watchdog := self["watchdog"]) <= 0 or not self["torque"]:
            return
        if t - self._heard_s > watchdog * WATCHDOG_UNIT_S:
            self._held_at = self._angle(t)
            self["watchdog"] = FIRED

    def count(self, t: float) -> int:
        """Return the encoder's absolute count at `t`, including turns."""
        model = self.model
        ticks = round(self._angle(t) / model.rad_per_tick) + model.zero_ticks
        if model.ticks_per_turn is None:
            return min(max(ticks, 0), 1023)
        return -ticks if self._is_reversed else ticks

    def position(self, t: float) -> int:
        """Return Present Position at `t` [ticks]."""
        counted = self.count(t) + self.glitch_ticks
        if self.model.protocol == 1:
            turn = self.model.ticks_per_turn
            return counted if turn is None else counted % turn
        return counted - self._base + self["homing_offset"]

    def read(self, address: int, size: int, t: float) -> tuple[Error, bytes]:
        """Read bytes of the control table at `t`."""
        if address + size > len(self._memory) or size == 0:
            return Error.ACCESS, b""
        block, places = self.model.layout.block, self.places(address, size)
        if any(block.address <= place < block.end for place in places):
            self._sense(t)
        if isinstance(places, range):
            return Error.NONE, bytes(self._memory[address : address + size])
        return Error.NONE, bytes(self._memory[place] for place in places)

    def places(self, address: int, size: int) -> Sequence[int]:
        """Return the effective addresses: those of Indirect Data are where their Indirect Address points."""
        if address + size <= self._first_indirect:
            return range(address, address + size)
        places = list(range(address, address + size))
        for data, pointer in self._indirect.items():
            if address <= data < address + size:
                places[data - address] = int.from_bytes(self._memory[pointer : pointer + 2], "little")
        return places

    def write(self, address: int, data: bytes, t: float) -> Error:
        for begin, part in self._runs(address, data):
            error = self._write(begin, part, t)
            if error is not Error.NONE:
                return error
        return Error.NONE if data else Error.ACCESS

    def _runs(self, address: int, data: bytes) -> list[tuple[int, bytes]]:
        """Split the bytes into runs of consecutive effective addresses."""
        places = self.places(address, len(data))
        if isinstance(places, range):
            return [(address, data)] if data else []
        begins = [k for k in range(len(places)) if k == 0 or places[k] != places[k - 1] + 1]
        return [(places[k], data[k:end]) for k, end in zip(begins, [*begins[1:], len(data)], strict=True)]

    def _write(self, address: int, data: bytes, t: float) -> Error:
        error = self._refusal(address, data)
        if error is not Error.NONE:
            return error
        had_torque, mode = self["torque"], self._mode
        self._angle(t)  # up to now the shaft has moved by the old values
        self._memory[address : address + len(data)] = data
        self._values.clear()
        if self._mode != mode and "current_limit" in self.model.layout:
            self["goal_current"] = self["current_limit"]  # e-Manual, Operating Mode
        if self["torque"] and not had_torque and self._is_in_position_mode:
            self._fold(t)  # e-Manual, Present Position: within one turn as soon as torque is on
        return Error.NONE

    def register_write(self, address: int, data: bytes) -> Error:
        """Store a write for ACTION."""
        error = self._refusal(address, data)
        if error is Error.NONE:
            self._registered = (address, data)
        return error

    def action(self, t: float) -> Error:
        """Execute the stored write."""
        if self._registered is None:
            return Error.RESULT
        address, data = self._registered
        self._registered = None
        return self.write(address, data, t)

    def reboot(self, t: float) -> None:
        """Restart as after a power cycle: RAM contents and the number of turns are lost."""
        fresh = bytearray(len(self._memory))
        fresh[: self.model.layout.ram] = self._memory[: self.model.layout.ram]
        self._memory = fresh
        self._values.clear()
        self._put_factory_values(self.model.layout.ram)
        self._point_indirect()
        for name in RAM_OF_FACTORY:
            if self.model.layout[name].address >= self.model.layout.ram:
                self[name] = self._factory[name]
        self._registered, self._error1 = None, 0
        self._booted_s = self._heard_s = t
        if "current_limit" in self.model.layout:
            self["goal_current"] = self["current_limit"]
        self._fold(t)

    def factory_reset(self, option: int, t: float) -> Error:
        """Restore factory values: 0xFF: all; 1: all but the ID; 2: all but ID and baud rate."""
        if option not in (0xFF, 1, 2):
            return Error.RANGE
        kept = {1: ("id",), 2: ("id", "baud")}.get(option, ())
        values = {name: self[name] for name in kept}
        self._reset_memory()
        for name, value in values.items():
            self[name] = value
        self.reboot(t)
        return Error.NONE

    def clear_turns(self, t: float) -> Error:
        """Execute CLEAR: reduce the position to one turn. Refused while torque is on."""
        if self["torque"]:
            return Error.ACCESS
        self._fold(t)
        return Error.NONE

    @property
    def _factory(self) -> dict[str, int]:
        return FACTORY1 if self.model.protocol == 1 else FACTORY2

    @property
    def _is_reversed(self) -> bool:
        return self._is_protocol2 and bool(self["drive_mode"] & REVERSE)

    @property
    def _mode(self) -> int:
        return self["operating_mode"] if self._is_protocol2 else POSITION_MODE

    @property
    def _is_in_position_mode(self) -> bool:
        return self._is_protocol2 and self["operating_mode"] == POSITION_MODE

    def _reset_memory(self) -> None:
        self._memory[:] = bytes(len(self._memory))
        self._values.clear()
        self._error1 = 0
        self._put_factory_values(0)
        self._point_indirect()
        self["model"] = self.model.number
        for name, value in self._factory.items():
            self[name] = value

    def _put_factory_values(self, begin: int) -> None:
        """Write the factory values from an address on."""
        for address, size, value in factory_values(self.model):
            if address >= begin:
                self._memory[address : address + size] = value.to_bytes(size, "little", signed=value < 0)
        self._values.clear()

    def _point_indirect(self) -> None:
        """Point each Indirect Address at its own Indirect Data."""
        for data, pointer in self._indirect.items():
            self._memory[pointer : pointer + 2] = data.to_bytes(2, "little")
        self._values.clear()

    def _fold(self, t: float) -> None:
        turn = self.model.ticks_per_turn
        if turn is None:
            return
        lowest = self.model.zero_ticks - turn // 2
        self._base = math.floor((self.count(t) - lowest) / turn) * turn

    def _sense(self, t: float, step_s: float = 0.01) -> None:
        """Write the measured values at `t` into the control table."""
        rad_s = (self._angle(t) - self._angle(t - step_s)) / step_s
        velocity = round(rad_s / self.model.velocity_unit)
        if self.model.protocol == 1:
            self["velocity"] = min(abs(velocity), 1023) | (0x400 if velocity < 0 else 0)
            self["moving"] = int(velocity != 0)
        else:
            self["velocity"] = -velocity if self._is_reversed else velocity
            self["moving"] = int(abs(velocity) > self["moving_threshold"])
            self["current"] = self._told_current(t)
            self["tick"] = int((t - self._booted_s) / TICK_S) % TICKS
        self["position"] = self.position(t)

    def _told_current(self, t: float) -> int:
        if self.model.current_unit is None:
            return 0
        ticks = round((self.motor_current(t) + self.excess_a) / self.model.current_unit)
        return -ticks if self._is_reversed else ticks

    def _refusal(self, address: int, data: bytes) -> Error:
        layout, end = self.model.layout, address + len(data)
        if end > len(self._memory) or not data:
            return Error.ACCESS
        if address < layout.ram and self["torque"] and self._is_protocol2:
            return Error.ACCESS
        for pointer in self._pointers.intersection(range(address, end - 1)):
            target = int.from_bytes(data[pointer - address : pointer - address + 2], "little")
            if not layout.ram <= target < len(self._memory):
                return Error.RANGE
        if any(begin < end and behind > address for begin, behind in self._read_only):
            return Error.ACCESS
        written = {
            name: layout.value(name, data, address)
            for name in self._judged
            if address <= self._places[name][0] and self._places[name][1] <= end
        }
        if any(value > LARGEST.get(name, value) for name, value in written.items()):
            return Error.LIMIT
        return self._refusal2(written) if self._is_protocol2 else Error.NONE

    def _refusal2(self, written: Mapping[str, int]) -> Error:
        """Return the error with which servos of Protocol 2.0 reject a write."""
        if self["watchdog"] == FIRED and any(name in written for name in GOALS):
            return Error.RANGE
        modes = MODES_WITHOUT if self.model.current_unit is None else MODES_WITH_CURRENT
        if written.get("operating_mode", POSITION_MODE) not in modes:
            return Error.RANGE
        if abs(written.get("goal_current", 0)) > self["current_limit"]:
            return Error.LIMIT
        within = self["min_position"] <= written.get("goal", self["min_position"]) <= self["max_position"]
        return Error.NONE if within or self._mode != POSITION_MODE else Error.LIMIT
