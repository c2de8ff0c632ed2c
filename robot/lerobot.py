"""LeRobot's conventions: motors of its arms, calibration files, and the units of its readings.

LeRobot (huggingface/lerobot, `motors/motors_bus.py`, v0.3 and later) keeps one JSON file for each arm. It contains for
each motor the servo's homing offset register, and the two ends of its range as the servo then reports them:

- Feetech: Present_Position = encoder − homing_offset. Dynamixel: Present_Position = encoder + homing_offset.
- degrees = (ticks − (range_min + range_max) / 2) · 360 / (ticks of a turn − 1), for any `drive_mode`.
- −100…100 and 0…100 are linear between the ends of the range and clipped there. `drive_mode = 1` reverses them for
  Feetech servos; Dynamixel servos reverse their own positions.

So 0° is the middle of the recorded range, and only the homing offset moves its physical position.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np

from bodyschema.interfaces.errors import ConfigError
from bodyschema.interfaces.records import FloatArray

from .limited import read_at_most

Unit = Literal["degrees", "range_m100_100", "range_0_100"]
Make = Literal["feetech", "dynamixel"]

TURN_TICKS = 4096  # of every servo in these arms
RAD_PER_TICK = 2.0 * math.pi / TURN_TICKS
GRIPPER = "gripper"
# The largest homing offset that a servo keeps [ticks]: Feetech's STS has a sign bit and eleven more.
LARGEST_OFFSET: Mapping[Make, int] = {"feetech": 2047, "dynamixel": 1_044_479}


@dataclass(frozen=True, slots=True)
class LeRobotArm:
    make: Make  # of its servos
    models: Mapping[str, str]  # of the motors, by their names in LeRobot; their IDs count from 1 in this order

    @property
    def joints(self) -> tuple[str, ...]:
        """The motors that move the hand."""
        return tuple(name for name in self.models if name != GRIPPER)

    def id(self, motor: str) -> int:
        return list(self.models).index(motor) + 1


_MOTORS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", GRIPPER)
_STS = LeRobotArm("feetech", dict.fromkeys(_MOTORS, "STS3215"))
# Sources: huggingface/lerobot, robots/so_follower, teleoperators/so_leader, robots/koch_follower,
# teleoperators/koch_leader; moss: its configs/robot/moss.yaml, which went with version 0.3.
ARMS: Mapping[str, LeRobotArm] = {
    "so101": _STS,
    "so100": _STS,
    "moss": _STS,
    "koch": LeRobotArm("dynamixel", dict(zip(_MOTORS, ("XL430-W250", "XL430-W250", *["XL330-M288"] * 4), strict=True))),
    "koch_leader": LeRobotArm("dynamixel", dict.fromkeys(_MOTORS, "XL330-M077")),
}


class MotorCalibration(msgspec.Struct, frozen=True):
    """LeRobot's calibration of one motor; all in ticks but `id` and `drive_mode`."""

    id: int
    drive_mode: int
    homing_offset: int
    range_min: int
    range_max: int

    @property
    def middle(self) -> float:
        """The position that LeRobot calls 0° [ticks]."""
        return (self.range_min + self.range_max) / 2

    def ticks(self, values: FloatArray, unit: Unit, make: Make) -> FloatArray:
        """Return the servo's positions [ticks] for LeRobot's readings in `unit`, of the same shape."""
        if unit == "degrees":
            return values * ((TURN_TICKS - 1) / 360.0) + self.middle
        turned = make == "feetech" and self.drive_mode != 0
        share = (values + 100.0) / 200.0 if unit == "range_m100_100" else values / 100.0
        return self.range_min + (1.0 - share if turned else share) * (self.range_max - self.range_min)

    def readings(self, ticks: FloatArray, unit: Unit, make: Make) -> FloatArray:
        """Return LeRobot's readings in `unit` at servo positions `ticks`: the inverse of `ticks`."""
        if unit == "degrees":
            return (ticks - self.middle) * 360.0 / (TURN_TICKS - 1)
        share = (np.clip(ticks, self.range_min, self.range_max) - self.range_min) / (self.range_max - self.range_min)
        share = 1.0 - share if make == "feetech" and self.drive_mode != 0 else share
        return 200.0 * share - 100.0 if unit == "range_m100_100" else 100.0 * share

    def moved(self, ticks: int, make: Make) -> MotorCalibration:
        """Return the calibration with which the servo reports `ticks` more at the same position; the range stays.

        Homing offsets that differ by whole turns are equivalent for a servo that counts one turn.
        """
        offset = self.homing_offset - ticks if make == "feetech" else self.homing_offset + ticks
        largest = LARGEST_OFFSET[make]
        if abs(offset) > largest:
            offset -= int(math.copysign(TURN_TICKS, offset))
        return msgspec.structs.replace(self, homing_offset=min(max(offset, -largest), largest))


Calibrations = Mapping[str, MotorCalibration]


def read_calibration(file: Path, motors: Sequence[str] = ()) -> dict[str, MotorCalibration]:
    """Read LeRobot's calibration of an arm, by motor.

    Raises:
        ConfigError: it cannot be read, is of an older LeRobot, or contains an impossible number.
    """
    again = "Let `lerobot-calibrate` write it again"
    try:
        found = msgspec.json.decode(read_at_most(file), type=dict[str, MotorCalibration])
    except OSError as error:
        raise ConfigError(f"cannot be read: {error.strerror}", file=file, remedy=where_calibrations_are()) from error
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        if re.search(rb'"(calib_mode|start_pos|motor_names)"', read_at_most(file)):
            raise ConfigError(
                "is a calibration of LeRobot before version 0.3, which counts angles in another way",
                file=file,
                remedy="Calibrate the arm with a present LeRobot",
            ) from error
        raise ConfigError(f"is no calibration of LeRobot: {error}", file=file, remedy=again) from error
    for name, motor in found.items():
        if motor.range_min >= motor.range_max:
            what = f"{name}: range_min {motor.range_min} is not below range_max {motor.range_max}"
            raise ConfigError(what, file=file, remedy=again)
    missing = [name for name in motors if name not in found]
    if missing:
        raise ConfigError(
            f"has no motor {', '.join(missing)}; it has {', '.join(found)}",
            file=file,
            remedy="Give the calibration of this arm",
        )
    return found


def calibration_json(calibrations: Calibrations) -> str:
    """Return the text of a calibration file, laid out as LeRobot writes it."""
    return msgspec.json.format(msgspec.json.encode(calibrations), indent=4).decode()


def where_calibrations_are() -> str:
    """Return a sentence on where LeRobot keeps its calibration files."""
    return "LeRobot keeps them in ~/.cache/huggingface/lerobot/calibration, in robots/ and teleoperators/"


@dataclass(frozen=True, slots=True)
class JointServo:
    """Conversion of servo ticks to a joint angle by robot.toml: q = direction · (ticks − zero_ticks) · RAD_PER_TICK."""

    joint: str
    make: Make
    direction: int
    zero_ticks: float

    def angles(self, ticks: FloatArray) -> FloatArray:
        """Return the joint's angles [rad] at servo positions `ticks`."""
        return self.direction * (ticks - self.zero_ticks) * RAD_PER_TICK


@dataclass(frozen=True, slots=True)
class Correction:
    """A joint offset written into a motor's calibration."""

    motor: str
    offset_rad: float  # to be added to the joint's readings
    ticks: int  # the whole ticks nearest to it, which the servo reports more
    before: MotorCalibration
    after: MotorCalibration


def corrections(
    calibrations: Calibrations, servos: Sequence[JointServo], offsets_rad: Mapping[str, float]
) -> list[Correction]:
    """Return the new homing offsets that add `offsets_rad` to the joints' readings.

    The ends of the ranges keep their numbers, and so do LeRobot's 0° and −100…100; their physical positions move by the
    offset.

    Raises:
        KeyError: a joint of `servos` with an offset is not among the motors.
    """
    found: list[Correction] = []
    for servo in servos:
        offset = offsets_rad.get(servo.joint)
        if offset is None:
            continue
        ticks, before = round(servo.direction * offset / RAD_PER_TICK), calibrations[servo.joint]
        found.append(Correction(servo.joint, offset, ticks, before, before.moved(ticks, servo.make)))
    return found
