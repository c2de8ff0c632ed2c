"""The tables of robot.toml for joints whose torque may be on: zero-force and gaze."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Annotated

import msgspec
from msgspec import Meta

from bodyschema.drivers.servos.config import ServoConfig
from bodyschema.drivers.servos.model import Model
from bodyschema.robot.suggest import did_you_mean
from bodyschema.robot.toml_file import Positive

from .models import TORQUE_AT_CURRENT

WATCHDOG_UNIT_S, LARGEST_WATCHDOG = 0.02, 127  # e-Manual, Bus Watchdog
Heartbeat = Annotated[float, Meta(ge=20, le=1e3 * WATCHDOG_UNIT_S * LARGEST_WATCHDOG)]

Mistake = tuple[tuple[str, ...], str, str]
"""Keys below the table, what is wrong, and what to do."""


class FloatingJoint(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The table [drivers.dynamixel.zero_force.joints.<joint>]: a joint that carries its part of the arm's weight."""

    current_limit_a: Positive  # upper limit of the current [A]
    # torque at the joint per current, including any gear [N·m/A]; without this key the model's value, if the manual's
    # figures are known
    torque_constant: Positive | None = None


class PoweredConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Settings common to both."""

    # a control loop slower than this switches torque off, and a servo that hears nothing for this long stops by itself
    # (Bus Watchdog, steps of 20 ms)
    heartbeat_ms: Heartbeat = 100.0
    max_temperature_c: Annotated[float, Meta(gt=0, le=80)] = 65.0  # torque goes off when a servo is hotter

    @property
    def heartbeat_s(self) -> float:
        """Heartbeat [s]."""
        return self.heartbeat_ms * 1e-3

    @property
    def watchdog(self) -> int:
        """Value of the Bus Watchdog register."""
        return math.ceil(self.heartbeat_s / WATCHDOG_UNIT_S - 1e-9)


class ZeroForceConfig(PoweredConfig, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The table [drivers.dynamixel.zero_force]: the servos carry the arm's weight for hand guiding."""

    # those that carry the arm; the torque of the others stays off
    joints: Annotated[dict[str, FloatingJoint], Meta(min_length=1)]
    max_speed_deg_s: Annotated[float, Meta(gt=0, le=360)] = 90.0  # torque goes off when a joint turns faster
    share: Annotated[float, Meta(gt=0, le=1)] = 1.0  # share of the arm's weight that is carried

    def torque_constant_of(self, servo: ServoConfig) -> float:
        """Return the torque constant of a joint's servo [N·m/A]; checked to be known."""
        torque, current = TORQUE_AT_CURRENT.get(servo.model, (math.nan, 1.0))
        return self.joints[servo.joint].torque_constant or torque / current

    def mistakes(self, servos: Sequence[ServoConfig], models: Mapping[str, Model]) -> Iterator[Mistake]:
        """Yield the mistakes of the table for these servos, whose models are known."""
        by_joint = {servo.joint: servo for servo in servos}
        for joint, table in self.joints.items():
            keys = ("joints", joint)
            if joint not in by_joint:
                yield keys, f"there is no joint {joint!r} with a servo", did_you_mean(joint, by_joint)
                continue
            model = models[by_joint[joint].model]
            if model.protocol == 1 or model.current_unit is None:
                yield (
                    keys,
                    f"joint {joint!r}: a {model.name} has no current control, so it cannot bear the arm",
                    "Leave the joint out (its torque stays off), or fit one with current control (docs/zero_force.md)",
                )
            elif table.torque_constant is None and model.name not in TORQUE_AT_CURRENT:
                yield (
                    keys,
                    f"joint {joint!r}: the torque constant of a {model.name} is not known here",
                    "Give torque_constant [N·m/A]: stall torque by stall current in its manual",
                )


class GazeConfig(PoweredConfig, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The table [drivers.dynamixel.gaze]: joints that turn the cameras to the hand."""

    joints: Annotated[tuple[str, ...], Meta(min_length=1)]  # those of the head; each is also one of [robot] joints
    limits_deg: dict[str, tuple[float, float]] = {}  # by joint, narrower limits than the URDF's [°]
    max_speed_deg_s: Annotated[float, Meta(gt=0, le=180)] = 30.0  # of the head's joints

    def mistakes(self, servos: Sequence[ServoConfig], models: Mapping[str, Model]) -> Iterator[Mistake]:
        """Yield the mistakes of the table for these servos, whose models are known."""
        by_joint = {servo.joint: servo for servo in servos}
        for joint in self.joints:
            if joint not in by_joint:
                yield ("joints",), f"there is no joint {joint!r} with a servo", did_you_mean(joint, by_joint)
            elif models[by_joint[joint].model].protocol == 1:
                yield (
                    ("joints",),
                    f"joint {joint!r}: a {by_joint[joint].model} has no watchdog that stops it when this program dies",
                    "Take a servo of Protocol 2.0 for the head",
                )
        for joint, (lower, upper) in self.limits_deg.items():
            if joint not in self.joints:
                yield (("limits_deg",), f"{joint!r} is not one of its joints", did_you_mean(joint, self.joints))
            elif lower >= upper:
                yield ("limits_deg",), f"joint {joint!r}: the lower limit is not below the upper one", "Swap them"
