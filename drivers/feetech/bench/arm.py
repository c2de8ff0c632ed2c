"""Emulate the Feetech servos of a robot.toml."""

from __future__ import annotations

from collections.abc import Sequence

from bodyschema.drivers.bench.asked_faults import ON_THE_WIRE, FaultKinds
from bodyschema.drivers.bench.device import Faults
from bodyschema.drivers.bench.dry_run import Angle
from bodyschema.drivers.bench.servo_arm import AT_THE_START, ServoArm
from bodyschema.drivers.feetech.config import FeetechConfig, ServoConfig
from bodyschema.drivers.feetech.models import BAUDS

from .chain import Chain
from .faults import swapped
from .servo import Servo

# Bits of the status.
ERRORS = {"voltage": 0x01, "encoder": 0x02, "hot": 0x04, "current": 0x08, "overload": 0x20}
KINDS = FaultKinds({**ON_THE_WIRE, "swapped": swapped}, (*ERRORS, *AT_THE_START, "glitch"))
OTHER_BAUD = {500_000: 1_000_000}  # any other rate: 500000


class FeetechArm(ServoArm[Servo, FeetechConfig]):
    """Feetech servos as configured; see `ServoArm`."""

    kinds, errors = KINDS, ERRORS

    def _servo(self, entry: ServoConfig, angle: Angle) -> Servo:
        baud = self._config.buses[self._config.bus_of(entry)].baud
        model, delay_s = self._config.model_of(entry), self._return_delay_s
        return Servo(model, entry.id, angle, baud=baud, return_delay_s=delay_s)

    def _chain(self, servos: Sequence[Servo], faults: Faults) -> Chain:
        return Chain(servos, faults)

    def _change_rate(self, servo: Servo) -> None:
        servo["baud"] = BAUDS.index(OTHER_BAUD.get(servo.baud, 500_000))
