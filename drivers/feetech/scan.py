"""Properties of Feetech servos that a scan needs."""

from __future__ import annotations

from bodyschema.drivers.servos.scan import Kind

from .joints import Bus
from .models import BAUDS, BY_NUMBER, HARDWARE_ERRORS, STS

FEETECH_SERVOS = Kind(
    name="Feetech",
    bauds=BAUDS,
    version=STS,
    models=BY_NUMBER,
    errors=HARDWARE_ERRORS,
    bus=Bus,
)
