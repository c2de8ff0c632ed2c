"""The table [drivers.dynamixel] of robot.toml."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar, Literal

import msgspec

from drivers.servos.config import NonNegative, ServoConfig, ServosConfig
from drivers.servos.model import Model

from .models import BY_NAME

__all__ = ["Baud", "BusConfig", "DynamixelConfig", "ServoConfig"]

Baud = Literal[9600, 57600, 115200, 1_000_000, 2_000_000, 3_000_000, 4_000_000]


class BusConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The table [drivers.dynamixel.buses.<name>]: a port with servos behind it.

    Attributes:
        port: best one of /dev/serial/by-id, which stays the same when it is plugged in again.
        baud: as the servos are set [bit/s].
        latency_ms: how long the adapter keeps bytes back; without this key the system is asked.
        fast_sync_read: `auto` asks the servos once whether they know it.
    """

    port: str
    baud: Baud = 1_000_000
    latency_ms: NonNegative | None = None
    fast_sync_read: Literal["auto", "never"] = "auto"


class DynamixelConfig(ServosConfig[BusConfig], frozen=True, forbid_unknown_fields=True):
    """The table [drivers.dynamixel]. MX-28 speaks Protocol 1.0, MX-28(2.0) speaks 2.0."""

    table: ClassVar[str] = "drivers.dynamixel"
    models: ClassVar[Mapping[str, Model]] = BY_NAME
