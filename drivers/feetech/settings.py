"""EEPROM settings of Feetech servos that can be changed.

Sources: Feetech, "SMS/STS memory table" and "SCSCL memory table" (doc.feetech.cn); addresses agree with SO-ARM's open
tables (huggingface/lerobot, motors/feetech/tables.py). The servos reject no value: the bounds are those of the tables.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

from bodyschema.drivers.servos.model import Model, Register
from bodyschema.drivers.servos.settings import BAUD, HOMING_OFFSET, ID, Setting

from .models import BAUDS, STS

LARGEST_ID = 252  # 253 is legal, but no robot.toml can name it
MODES = {"position": 0, "velocity": 1, "pwm": 2, "step": 3}
FARTHEST_OFFSET = 2047

RENAMED = "set id in robot.toml"
OTHER_RATE = "set baud in robot.toml; all servos of a bus need the same"
OTHER_ZERO = "the joint's zero moves: pairs measured before do not fit those after"


def settings_of(model: Model) -> Sequence[Setting]:
    """Return the settings of a model, in the order of their addresses."""
    found = [*_common(model), *(_of_sts(model) if model.protocol == STS else ())]
    return sorted(found, key=lambda setting: setting.register.address)


def _common(model: Model) -> Iterator[Setting]:
    layout, order = model.layout, model.layout["model"].order
    farthest = (model.ticks_per_turn or 1024) - 1
    yield Setting(ID, layout["id"], 0, LARGEST_ID, follows=RENAMED)
    yield Setting(BAUD, layout["baud"], 0, 7, {str(b): place for place, b in enumerate(BAUDS)}, follows=OTHER_RATE)
    yield Setting("return_delay", layout["return_delay"], 0, 254, per_unit=2, unit="µs")
    # With 0 it answers reads but no writes.
    yield Setting("status_return", layout["status_return"], 0, 1)
    yield Setting("min_position_limit", Register(9, 2, order=order), 0, farthest)
    yield Setting("max_position_limit", Register(11, 2, order=order), 0, farthest)
    yield Setting("temperature_limit", Register(13, 1), 0, 100, unit="°C")
    yield Setting("max_voltage_limit", Register(14, 1), 0, 254, per_unit=0.1, unit="V")
    yield Setting("min_voltage_limit", Register(15, 1), 0, 254, per_unit=0.1, unit="V")
    yield Setting("max_torque", Register(16, 2, order=order), 0, 1000, per_unit=0.1, unit="%")
    yield Setting(
        "drive_mode",
        layout["drive_mode"],
        0,
        254,
        follows=f"its maker calls it Phase: not without their manual. {OTHER_ZERO}",
    )
    yield Setting("unloading", layout["unloading"], 0, 254, follows="which troubles switch its torque off")
    yield Setting("alarm_led", Register(20, 1), 0, 254)


def _of_sts(model: Model) -> Iterator[Setting]:
    layout, degrees = model.layout, math.degrees(model.rad_per_tick)
    homing = (layout["homing_offset"], -FARTHEST_OFFSET, FARTHEST_OFFSET)
    yield Setting("protection_current", Register(28, 2), 0, 511, per_unit=model.current_unit or 1.0, unit="A")
    yield Setting(HOMING_OFFSET, *homing, per_unit=degrees, unit="°", follows=OTHER_ZERO)
    modes = "in step mode the position is not the joint's"
    yield Setting("operating_mode", layout["operating_mode"], 0, 3, MODES, follows=modes)
    yield Setting("protective_torque", Register(34, 1), 0, 100, unit="%")
    yield Setting("overload_torque", Register(36, 1), 0, 100, unit="%")
