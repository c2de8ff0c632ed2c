"""Before the first reading; see `drivers.servos.handshake`."""

from __future__ import annotations

from drivers.servos.config import ServoConfig
from drivers.servos.handshake import Finding, FittedServo, require_all, restore_torque, switch_torque_off, torque_is_on
from drivers.servos.handshake import identify as identify_as

from .bus import Bus
from .models import BY_NAME, BY_NUMBER

__all__ = [
    "Finding",
    "FittedServo",
    "identify",
    "require_all",
    "restore_torque",
    "switch_torque_off",
    "torque_is_on",
]


def identify(bus: Bus, config: ServoConfig) -> Finding:
    """Ask the servo of `config` who it is."""
    return identify_as(bus, config, BY_NAME[config.model], BY_NUMBER)
