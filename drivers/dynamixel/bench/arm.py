"""Emulate the Dynamixel servos of a robot.toml."""

from __future__ import annotations

from collections.abc import Sequence

from bodyschema.drivers.bench.asked_faults import ON_THE_WIRE, FaultKinds
from bodyschema.drivers.bench.device import Faults
from bodyschema.drivers.bench.dry_run import Angle
from bodyschema.drivers.bench.servo_arm import AT_THE_START, ServoArm
from bodyschema.drivers.dynamixel.config import DynamixelConfig, ServoConfig
from bodyschema.drivers.dynamixel.models import baud_value

from .chain import Chain
from .driven_shaft import DrivenShaft
from .faults import swapped
from .servo import Servo

# Bits of Hardware Error Status.
ERRORS = {"voltage": 0x01, "hot": 0x04, "encoder": 0x08, "shock": 0x10, "overload": 0x20}
KINDS = FaultKinds({**ON_THE_WIRE, "swapped": swapped}, (*ERRORS, *AT_THE_START, "glitch"))
OTHER_BAUD = {57600: 1_000_000}  # any other rate: 57600


class DynamixelArm(ServoArm[Servo, DynamixelConfig]):
    """Dynamixel servos as configured; see `ServoArm`.

    Joints of the gaze begin at their start position and follow their servos.
    """

    kinds, errors = KINDS, ERRORS

    def _servo(self, entry: ServoConfig, angle: Angle) -> Servo:
        baud = self._config.buses[self._config.bus_of(entry)].baud
        booted_s = self._now() - self._rng.uniform(1, 9)
        model, delay_s = self._config.model_of(entry), self._return_delay_s
        gaze = self._config.gaze
        driven = DrivenShaft(angle(self._now())) if gaze is not None and entry.joint in gaze.joints else None
        servo = Servo(model, entry.id, driven or angle, baud=baud, return_delay_s=delay_s, booted_s=booted_s)
        if driven is not None:
            driven.servo = servo
        return servo

    def _chain(self, servos: Sequence[Servo], faults: Faults) -> Chain:
        return Chain(servos, faults)

    def _begin(self, kind: str, joint: str) -> None:
        servo = self.servo(joint)
        if kind == "torque":
            servo["goal"] = servo.position(self._now())  # it holds its present position
        super()._begin(kind, joint)

    def _change_rate(self, servo: Servo) -> None:
        servo["baud"] = baud_value(servo.model.layout, OTHER_BAUD.get(servo.baud, 57600))
