"""Supported Feetech models: numbers, names, units, and addresses of the registers in use.

Sources: Feetech, "SMS/STS memory table" and "SCSCL memory table" (doc.feetech.cn), and SO-ARM's open tables of the same
(huggingface/lerobot, motors/feetech/tables.py), with which addresses, model numbers and baud rates agree. STS and SMS
are little endian, SCS is big endian. Signed numbers have a sign bit and a magnitude.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import Literal

from bodyschema.drivers.servos.model import Layout, Model, Register

STS, SCS = 0, 1  # Feetech's own numbers of the byte orders
Order = Literal["little", "big"]


def _registers(order: Order) -> dict[str, Register]:
    """Return the registers common to both series."""
    return {
        "firmware": Register(0, 2, order="big"),  # major, minor
        "model": Register(3, 2, order=order),
        "id": Register(5, 1),
        "baud": Register(6, 1),
        "return_delay": Register(7, 1),
        "status_return": Register(8, 1),
        "drive_mode": Register(18, 1),  # Phase
        "unloading": Register(19, 1),
        "torque": Register(40, 1),
        "goal": Register(42, 2, sign_bit=15, order=order),
        "position": Register(56, 2, sign_bit=15, order=order),
        "velocity": Register(58, 2, sign_bit=15, order=order),
        "load": Register(60, 2, sign_bit=10, order=order),
        "voltage": Register(62, 1),
        "temperature": Register(63, 1),
        "status": Register(65, 1),
        "moving": Register(66, 1),
    }


LAYOUT_STS = Layout(
    STS,
    MappingProxyType(
        _registers("little")
        | {
            "homing_offset": Register(31, 2, sign_bit=11),
            "operating_mode": Register(33, 1),
            "lock": Register(55, 1),
            "current": Register(69, 2, sign_bit=15),
        }
    ),
    block=Register(56, 15),
    state=Register(40, 1),
    ram=40,
    size=87,
)
LAYOUT_SCS = Layout(
    SCS,
    MappingProxyType(_registers("big") | {"lock": Register(48, 1)}),
    block=Register(56, 11),
    state=Register(40, 1),
    ram=40,
    size=84,
)


def _sts(number: int, name: str) -> Model:
    step = 2 * math.pi / 4096
    return Model(number, name, "STS", LAYOUT_STS, step, 4096, 2048, step, 6.5e-3)


def _scs(number: int, name: str) -> Model:
    step = math.radians(300) / 1024
    return Model(number, name, "SCS", LAYOUT_SCS, step, None, 512, step, None)


MODELS: tuple[Model, ...] = (
    _sts(777, "STS3215"),
    _sts(2825, "STS3250"),
    _sts(11272, "SM8512BL"),
    _scs(1284, "SCS0009"),
)
BY_NAME: Mapping[str, Model] = MappingProxyType({model.name: model for model in MODELS})
BY_NUMBER: Mapping[int, Model] = MappingProxyType({model.number: model for model in MODELS})

BAUDS = (1_000_000, 500_000, 250_000, 128_000, 115_200, 57_600, 38_400, 19_200)  # by the register's value [bit/s]

# Status (65), which is also the error byte of every answer.
HARDWARE_ERRORS: Mapping[int, str] = MappingProxyType(
    {
        0x01: "its supply voltage is out of range: check the supply and its cable",
        0x02: "its position sensor fails, or it is beyond its angle limits: look at the joint, else replace the servo",
        0x04: "it is too hot: let it cool down",
        0x08: "its motor draws too much current: free the joint, then switch its supply off and on",
        0x10: "it is beyond its angle limits: turn the joint back",
        0x20: "it is overloaded: free the joint, then switch its supply off and on",
    }
)
PING, READ, WRITE, SYNC_READ = 1, 2, 3, 0x82
MODES = {"position": 0, "velocity": 1, "pwm": 2, "step": 3}
