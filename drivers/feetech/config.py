"""The table [drivers.feetech] of robot.toml."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar, Literal

from bodyschema.drivers.servos.config import ServoBusConfig, ServoConfig, ServosConfig
from bodyschema.drivers.servos.model import Model

from .models import BY_NAME

__all__ = ["Baud", "BusConfig", "FeetechConfig", "ServoConfig"]

Baud = Literal[19_200, 38_400, 57_600, 115_200, 128_000, 250_000, 500_000, 1_000_000]


class BusConfig(ServoBusConfig, frozen=True, forbid_unknown_fields=True):
    """The table [drivers.feetech.buses.<name>]: a port with servos behind it."""

    baud: Baud = 1_000_000  # as the servos are set [bit/s]
    sync_read: Literal["auto", "never"] = "auto"  # `auto` tests once if the servos of the STS and SMS series support it


class FeetechConfig(ServosConfig[BusConfig], frozen=True, forbid_unknown_fields=True):
    """The table [drivers.feetech]."""

    table: ClassVar[str] = "feetech"
    models: ClassVar[Mapping[str, Model]] = BY_NAME
