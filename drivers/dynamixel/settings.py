"""EEPROM settings of Dynamixel servos that can be changed.

Sources: ROBOTIS e-Manual, "Control Table of EEPROM Area" of X, P, MX(2.0), MX and AX. Addresses agree with the control
tables of dynamixel-sdk, which a test compares. A model with narrower bounds rejects a value itself.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

from bodyschema.drivers.servos.model import Model, Register
from bodyschema.drivers.servos.settings import BAUD, HOMING_OFFSET, ID, Setting

from .models import LAYOUT_MX1, baud_value

BAUDS2 = (9600, 57_600, 115_200, 1_000_000, 2_000_000, 3_000_000, 4_000_000)
BAUDS1 = (9600, 57_600, 115_200, 1_000_000)  # the register allows others that robot.toml does not
MODES = {"velocity": 1, "position": 3, "extended": 4, "pwm": 16}
CURRENT_MODES = {"current": 0, "current_position": 5}
FARTHEST_OFFSET = 1_044_479  # 255 turns
NEAR_OFFSET = 1024  # a larger one is ignored in position mode
LARGEST_ID = 252

RENAMED = "set id in robot.toml"
OTHER_RATE = "set baud in robot.toml; all servos of a bus need the same"
OTHER_ZERO = "the joint's zero moves: pairs measured before do not fit those after"


def settings_of(model: Model) -> Sequence[Setting]:
    """Return the settings of a model, in the order of their addresses."""
    found = _of_protocol1(model) if model.protocol == 1 else _of_protocol2(model)
    return sorted(found, key=lambda setting: setting.register.address)


def _common(model: Model) -> Iterator[Setting]:
    layout = model.layout
    bauds = BAUDS1 if model.protocol == 1 else BAUDS2
    yield Setting(ID, layout["id"], 0, LARGEST_ID, follows=RENAMED)
    yield Setting(
        BAUD, layout["baud"], 0, 254, {str(baud): baud_value(layout, baud) for baud in bauds}, follows=OTHER_RATE
    )
    yield Setting("return_delay", layout["return_delay"], 0, 254, per_unit=2, unit="µs")
    yield Setting("shutdown", layout["shutdown"], 0, 0x7F, follows="which troubles switch its torque off")


def _of_protocol2(model: Model) -> Iterator[Setting]:
    layout, degrees = model.layout, math.degrees(model.rad_per_tick)
    yield from _common(model)
    yield Setting("drive_mode", layout["drive_mode"], 0, 0x0D, follows=f"bit 0: it counts the other way; {OTHER_ZERO}")
    yield Setting("operating_mode", layout["operating_mode"], 0, 16, _modes(model), follows=_turns(model))
    yield Setting("secondary_id", Register(12, 1), 0, 255, follows="above 252: none")
    farthest = FARTHEST_OFFSET if model.series != "P" else 2**31 - 1
    homing = (layout["homing_offset"], -farthest, farthest)
    yield Setting(HOMING_OFFSET, *homing, per_unit=degrees, unit="°", follows=OTHER_ZERO)
    yield Setting("moving_threshold", layout["moving_threshold"], 0, 2**31 - 1)
    yield Setting("temperature_limit", Register(31, 1), 0, 100, unit="°C")
    yield Setting("max_voltage_limit", Register(32, 2), 60, 400, per_unit=0.1, unit="V")
    yield Setting("min_voltage_limit", Register(34, 2), 30, 400, per_unit=0.1, unit="V")
    yield Setting("pwm_limit", Register(36, 2), 0, 2009)
    if model.current_unit is not None:
        yield Setting("current_limit", Register(38, 2), 0, 2**15 - 1, per_unit=model.current_unit, unit="A")
    yield Setting("velocity_limit", Register(44, 4), 0, 2**31 - 1)
    bounds = (0, 4095) if model.series != "P" else (-(2**31), 2**31 - 1)
    yield Setting("max_position_limit", Register(48, 4, signed=True), *bounds)
    yield Setting("min_position_limit", Register(52, 4, signed=True), *bounds)


def _modes(model: Model) -> dict[str, int]:
    with_current = dict(CURRENT_MODES) if model.current_unit is not None else {}
    if model.series == "P":
        with_current.pop("current_position", None)
    return with_current | MODES


def _turns(model: Model) -> str:
    near = "" if model.series == "P" else f"; in position mode a homing_offset beyond ±{NEAR_OFFSET} is ignored"
    return f"its turn count may be lost{near}"


def _of_protocol1(model: Model) -> Iterator[Setting]:
    yield from _common(model)
    ticks = 4095 if model.layout is LAYOUT_MX1 else 1023
    yield Setting("cw_angle_limit", Register(6, 2), 0, ticks)
    yield Setting("ccw_angle_limit", Register(8, 2), 0, ticks)
    yield Setting("temperature_limit", Register(11, 1), 0, 99, unit="°C")
    yield Setting("min_voltage_limit", Register(12, 1), 50, 160, per_unit=0.1, unit="V")
    yield Setting("max_voltage_limit", Register(13, 1), 50, 160, per_unit=0.1, unit="V")
    yield Setting("max_torque", Register(14, 2), 0, 1023)
    # With 0 the servo answers no read, so the written value could not be verified.
    yield Setting("status_return", model.layout["status_return"], 1, 2)
    yield Setting("alarm_led", Register(17, 1), 0, 0x7F)
    if model.layout is LAYOUT_MX1:
        degrees = math.degrees(model.rad_per_tick)
        offset = Register(20, 2, signed=True)
        yield Setting("multi_turn_offset", offset, -24_576, 24_576, per_unit=degrees, unit="°", follows=OTHER_ZERO)
        yield Setting("resolution_divider", Register(22, 1), 1, 4, follows=OTHER_ZERO)
