"""The table [drivers.feetech] of robot.toml."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar, Literal

import msgspec

from bodyschema.drivers.servos.config import ServoConfig, ServosConfig
from bodyschema.drivers.servos.model import Model
from bodyschema.robot.toml_file import NonNegative

from .models import BY_NAME

__all__ = ["Baud", "BusConfig", "FeetechConfig", "ServoConfig"]

Baud = Literal[19_200, 38_400, 57_600, 115_200, 128_000, 250_000, 500_000, 1_000_000]


class BusConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The table [drivers.feetech.buses.<name>]: a port with servos behind it."""

    port: str  # best one of /dev/serial/by-id, which stays the same when it is plugged in again
    baud: Baud = 1_000_000  # as the servos are set [bit/s]
    # how long the adapter holds bytes back; without this key the system's value is used
    latency_ms: NonNegative | None = None
    sync_read: Literal["auto", "never"] = "auto"  # `auto` tests once if the servos of the STS and SMS series support it


class FeetechConfig(ServosConfig[BusConfig], frozen=True, forbid_unknown_fields=True):
    """The table [drivers.feetech]."""

    table: ClassVar[str] = "drivers.feetech"
    models: ClassVar[Mapping[str, Model]] = BY_NAME
