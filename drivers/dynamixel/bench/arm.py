"""The Dynamixel servos that a robot.toml describes, on a bench."""

from __future__ import annotations

from collections.abc import Sequence

from drivers.bench.asked_faults import ON_THE_WIRE, FaultKinds
from drivers.bench.device import Faults
from drivers.bench.dry_run import Angle
from drivers.bench.servo_arm import AT_THE_START, ServoArm
from drivers.dynamixel.config import DynamixelConfig, ServoConfig
from drivers.dynamixel.models import baud_value

from .chain import Chain
from .faults import swapped
from .servo import Servo

# Bits of Hardware Error Status.
ERRORS = {"voltage": 0x01, "hot": 0x04, "encoder": 0x08, "shock": 0x10, "overload": 0x20}
KINDS = FaultKinds({**ON_THE_WIRE, "swapped": swapped}, (*ERRORS, *AT_THE_START, "glitch"))
OTHER_BAUD = {57600: 1_000_000}  # any other rate: 57600


class DynamixelArm(ServoArm[Servo, DynamixelConfig]):
    """Dynamixel servos as they are configured; see `ServoArm`."""

    kinds, errors = KINDS, ERRORS

    def _servo(self, entry: ServoConfig, angle: Angle) -> Servo:
        baud = self._config.buses[self._config.bus_of(entry)].baud
        booted_s = self._now() - self._rng.uniform(1, 9)
        model, delay_s = self._config.model_of(entry), self._return_delay_s
        return Servo(model, entry.id, angle, baud=baud, return_delay_s=delay_s, booted_s=booted_s)

    def _chain(self, servos: Sequence[Servo], faults: Faults) -> Chain:
        return Chain(servos, faults)

    def _change_rate(self, servo: Servo) -> None:
        servo["baud"] = baud_value(servo.model.layout, OTHER_BAUD.get(servo.baud, 57600))
