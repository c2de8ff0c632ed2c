"""Supported Dynamixel models: numbers, names, units, and addresses of the registers in use.

Sources: ROBOTIS e-Manual, "Control Table of EEPROM Area" and "... of RAM Area" of each model (X, P, MX(2.0), MX, AX);
model numbers, addresses and units of the newer ones agree with the control tables that dynamixel-sdk 4.1 carries
(`dynamixel_easy_sdk/control_table/*.model`), which a test compares. These give π as 4095 ticks; a turn has 4096.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import Literal

from bodyschema.drivers.servos.model import Layout, Model, Register

__all__ = ["BY_NAME", "BY_NUMBER", "MODELS", "UNSUPPORTED", "Layout", "Model", "Register"]

Series = Literal["X", "P", "MX", "AX"]


def _layout2(torque: int, size: int) -> Layout:
    """Return the layout of Protocol 2.0. The RAM area of the P series is that of the X series, shifted by 448."""
    places = {
        "model": Register(0, 2),
        "firmware": Register(6, 1),
        "id": Register(7, 1),
        "baud": Register(8, 1),
        "return_delay": Register(9, 1),
        "drive_mode": Register(10, 1),
        "operating_mode": Register(11, 1),
        "homing_offset": Register(20, 4, signed=True),
        "moving_threshold": Register(24, 4),
        "current_limit": Register(38, 2),
        "max_position": Register(48, 4, signed=True),
        "min_position": Register(52, 4, signed=True),
        "shutdown": Register(63, 1),
        "torque": Register(torque, 1),
        "status_return": Register(torque + 4, 1),
        "hardware_error": Register(torque + 6, 1),
        "watchdog": Register(torque + 34, 1, signed=True),
        "goal_current": Register(torque + 38, 2, signed=True),
        "goal": Register(torque + 52, 4, signed=True),
        "tick": Register(torque + 56, 2),
        "moving": Register(torque + 58, 1),
        "current": Register(torque + 62, 2, signed=True),
        "velocity": Register(torque + 64, 4, signed=True),
        "position": Register(torque + 68, 4, signed=True),
        "voltage": Register(torque + 80, 2),
        "temperature": Register(torque + 82, 1),
    }
    registers = MappingProxyType(places)
    return Layout(2, registers, Register(torque + 56, 16), Register(torque, 7), ram=torque, size=size)


def _layout1(size: int) -> Layout:
    places = {
        "model": Register(0, 2),
        "firmware": Register(2, 1),
        "id": Register(3, 1),
        "baud": Register(4, 1),
        "return_delay": Register(5, 1),
        "status_return": Register(16, 1),
        "shutdown": Register(18, 1),
        "torque": Register(24, 1),
        "goal": Register(30, 2),
        "position": Register(36, 2, signed=True),
        "velocity": Register(38, 2),
        "current": Register(40, 2),
        "voltage": Register(42, 1),
        "temperature": Register(43, 1),
        "moving": Register(46, 1),
    }
    return Layout(1, MappingProxyType(places), Register(36, 11), Register(24, 1), ram=24, size=size)


LAYOUT_X = _layout2(64, 662)
LAYOUT_P = _layout2(512, 762)
LAYOUT_MX1 = _layout1(74)
LAYOUT_AX = _layout1(50)


RPM = 2 * math.pi / 60


def _x(number: int, name: str, current_unit: float | None, series: Series = "X") -> Model:
    return Model(number, name, series, LAYOUT_X, 2 * math.pi / 4096, 4096, 2048, 0.229 * RPM, current_unit)


def _p(number: int, name: str, ticks_per_turn: int) -> Model:
    step = 2 * math.pi / ticks_per_turn
    return Model(number, name, "P", LAYOUT_P, step, ticks_per_turn, 0, 0.01 * RPM, 0.001)


def _mx1(number: int, name: str) -> Model:
    return Model(number, name, "MX", LAYOUT_MX1, 2 * math.pi / 4096, 4096, 2048, 0.114 * RPM, None)


def _ax(number: int, name: str) -> Model:
    return Model(number, name, "AX", LAYOUT_AX, math.radians(300) / 1024, None, 512, 0.111 * RPM, None)


MODELS: tuple[Model, ...] = (
    _x(30, "MX-28(2.0)", None, "MX"),
    _x(311, "MX-64(2.0)", 3.36e-3, "MX"),
    _x(321, "MX-106(2.0)", 3.36e-3, "MX"),
    _x(1000, "XH430-W350", 2.69e-3),
    _x(1001, "XD430-T350", 2.69e-3),
    _x(1010, "XH430-W210", 2.69e-3),
    _x(1011, "XD430-T210", 2.69e-3),
    _x(1020, "XM430-W350", 2.69e-3),
    _x(1030, "XM430-W210", 2.69e-3),
    _x(1040, "XH430-V350", 1.34e-3),
    _x(1050, "XH430-V210", 1.34e-3),
    _x(1060, "XL430-W250", None),
    _x(1070, "XC430-W150", None),
    _x(1080, "XC430-W240", None),
    _x(1090, "2XL430-W250", None),
    _x(1100, "XH540-W270", 2.69e-3),
    _x(1101, "XD540-T270", 2.69e-3),
    _x(1110, "XH540-W150", 2.69e-3),
    _x(1111, "XD540-T150", 2.69e-3),
    _x(1120, "XM540-W270", 2.69e-3),
    _x(1130, "XM540-W150", 2.69e-3),
    _x(1140, "XH540-V270", 1.34e-3),
    _x(1150, "XH540-V150", 1.34e-3),
    _x(1160, "2XC430-W250", None),
    _x(1170, "XW540-T260", 2.69e-3),
    _x(1180, "XW540-T140", 2.69e-3),
    _x(1190, "XL330-M077", 1e-3),
    _x(1200, "XL330-M288", 1e-3),
    _x(1210, "XC330-T181", 1e-3),
    _x(1220, "XC330-T288", 1e-3),
    _x(1230, "XC330-M181", 1e-3),
    _x(1240, "XC330-M288", 1e-3),
    _x(1270, "XW430-T333", 2.69e-3),
    _x(1310, "XW540-H260", 2.69e-3),
    _p(2000, "PH42-020-S300", 607_500),
    _p(2010, "PH54-100-S500", 1_003_846),
    _p(2020, "PH54-200-S500", 1_003_846),
    _p(2100, "PM42-010-S260", 526_374),
    _p(2110, "PM54-040-S250", 502_834),
    _p(2120, "PM54-060-S250", 502_834),
    _ax(12, "AX-12A"),
    _ax(18, "AX-18A"),
    _ax(300, "AX-12W"),
    _mx1(360, "MX-12W"),
    _mx1(29, "MX-28"),
    _mx1(310, "MX-64"),
    _mx1(320, "MX-106"),
)
BY_NAME: Mapping[str, Model] = MappingProxyType({model.name: model for model in MODELS})
BY_NUMBER: Mapping[int, Model] = MappingProxyType({model.number: model for model in MODELS})
# e-Manual, XL-320: ID at 3, torque at 24, position at 37, 2 bytes. It has no clock and no block with all readings.
UNSUPPORTED: Mapping[int, str] = MappingProxyType({350: "XL-320"})

# Register values of the baud rate [bit/s].
BAUDS2 = (9600, 57600, 115200, 1_000_000, 2_000_000, 3_000_000, 4_000_000, 4_500_000)
TICK_S, TICKS = 1e-3, 32768  # Realtime Tick


def baud_of(layout: Layout, value: int) -> int:
    """Return the baud rate [bit/s] of a register value."""
    if layout.protocol == 1:
        return round(2_000_000 / (value + 1))
    return BAUDS2[min(value, len(BAUDS2) - 1)]


def baud_value(layout: Layout, baud: int) -> int:
    """Return the register value of a baud rate [bit/s]."""
    if layout.protocol == 1:
        return round(2_000_000 / baud) - 1
    return BAUDS2.index(baud)


# Hardware Error Status of Protocol 2.0 and the error byte of Protocol 1.0 use the same bits.
HARDWARE_ERRORS: Mapping[int, str] = MappingProxyType(
    {
        0x01: "its supply voltage is out of range: check the supply and its cable",
        0x04: "it is too hot: let it cool down",
        0x08: "its motor's encoder fails: the servo has to be repaired",
        0x10: "its circuit is damaged or its motor gets too little power: check supply and cable, else repair it",
        0x20: "it is overloaded: free the joint, then switch its supply off and on",
    }
)
BAUDS1 = (9600, 57_600, 115_200, 1_000_000)  # the register allows others that robot.toml does not
MODES = {"velocity": 1, "position": 3, "extended": 4, "pwm": 16}
CURRENT_MODES = {"current": 0, "current_position": 5}
NEAR_OFFSET = 1024  # a larger one is ignored in position mode
SIGN1, NUMBER1 = 0x400, 0x3FF  # sign and magnitude of Protocol 1.0
FAST_HEADER = 8  # bytes before the first servo's part
FASTEST1 = 3_000_000  # of Protocol 1.0
PING_SLOT_S = 3e-3  # a servo of Protocol 2.0 waits this long for each ID below its own to answer a broadcast PING
# By model: torque [N·m] and the corresponding current [A].
TORQUE_AT_CURRENT: Mapping[str, tuple[float, float]] = MappingProxyType(
    {
        "MX-64(2.0)": (6.0, 4.1),
        "MX-106(2.0)": (8.4, 5.2),
        "XL330-M077": (0.215, 1.47),
        "XL330-M288": (0.52, 1.47),
        "XC330-M181": (0.60, 1.80),
        "XC330-M288": (0.93, 1.80),
        "XC330-T181": (0.76, 0.80),
        "XC330-T288": (0.92, 0.80),
        "XM430-W210": (3.0, 2.3),
        "XM430-W350": (4.1, 2.3),
        "XH430-W210": (2.5, 1.3),
        "XH430-W350": (3.4, 1.3),
        "XH430-V210": (2.6, 0.7),
        "XH430-V350": (3.3, 0.7),
        "XD430-T210": (2.5, 1.3),
        "XD430-T350": (3.4, 1.3),
        "XW430-T333": (3.1, 1.3),
        "XM540-W150": (7.3, 4.4),
        "XM540-W270": (10.6, 4.4),
        "XH540-W150": (7.1, 4.9),
        "XH540-W270": (9.9, 4.9),
        "XH540-V150": (6.4, 2.4),
        "XH540-V270": (9.2, 2.4),
        "XD540-T150": (7.1, 4.9),
        "XD540-T270": (9.9, 4.9),
        "XW540-T140": (6.9, 4.9),
        "XW540-T260": (9.5, 4.9),
        "PH42-020-S300": (5.1, 1.5),
        "PH54-100-S500": (25.3, 5.5),
        "PH54-200-S500": (44.7, 9.3),
        "PM42-010-S260": (1.7, 0.6),
        "PM54-040-S250": (3.9, 1.9),
        "PM54-060-S250": (10.1, 3.0),
    }
)
