"""The table [drivers.dynamixel] of robot.toml."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import ClassVar, Literal

from bodyschema.drivers.servos.config import ServoBusConfig, ServoConfig, ServosConfig
from bodyschema.drivers.servos.model import Model
from bodyschema.interfaces.errors import ConfigError
from bodyschema.robot.toml_file import line_of

from .models import BY_NAME, UNSUPPORTED
from .powered_config import GazeConfig, ZeroForceConfig

__all__ = ["Baud", "BusConfig", "DynamixelConfig", "ServoConfig"]


Baud = Literal[9600, 57600, 115200, 1_000_000, 2_000_000, 3_000_000, 4_000_000]


class BusConfig(ServoBusConfig, frozen=True, forbid_unknown_fields=True):
    """The table [drivers.dynamixel.buses.<name>]: a port with servos behind it."""

    baud: Baud = 1_000_000  # as the servos are set [bit/s]
    fast_sync_read: Literal["auto", "never"] = "auto"  # `auto` tests once if the servos support it


class DynamixelConfig(ServosConfig[BusConfig], frozen=True, forbid_unknown_fields=True):
    """The table [drivers.dynamixel]. MX-28 speaks Protocol 1.0, MX-28(2.0) speaks 2.0."""

    table: ClassVar[str] = "dynamixel"
    models: ClassVar[Mapping[str, Model]] = BY_NAME
    unsupported: ClassVar[Collection[str]] = tuple(UNSUPPORTED.values())

    # joints that carry the arm's weight on request. Without this table none ever does.
    zero_force: ZeroForceConfig | None = None
    gaze: GazeConfig | None = None  # joints that turn the cameras to the hand on request

    def check(self, joints: Sequence[str], file: Path, text: str) -> None:
        """Raise ConfigError if servos, zero-force or gaze do not fit `joints` or each other; see `ServosConfig`."""
        super().check(joints, file, text)
        for name, keys, what, remedy in self._powered_mistakes():
            table = ("drivers", self.table, name)
            line = line_of(text, (*table, *keys)) or line_of(text, table)
            raise ConfigError(f"[{'.'.join(table)}] {what}", file=file, line=line, remedy=remedy)

    def _powered_mistakes(self) -> Iterator[tuple[str, tuple[str, ...], str, str]]:
        for name, table in (("zero_force", self.zero_force), ("gaze", self.gaze)):
            if table is None:
                continue
            for keys, what, remedy in table.mistakes(self.servos, self.models):
                yield name, keys, what, remedy
            shortest_s = 4 / self.rate_hz  # so many cycles within a heartbeat
            if table.heartbeat_s < shortest_s:
                yield (
                    name,
                    ("heartbeat_ms",),
                    f"rate_hz = {self.rate_hz:g} is too slow for its heartbeat",
                    f"Give a heartbeat_ms of at least {1e3 * shortest_s:.0f}, or a higher rate_hz",
                )
            if self.restore_torque:
                yield name, (), "restore_torque switches torque on again at the end", "Take one of the two out"
        if self.zero_force is not None and self.gaze is not None:
            for joint in self.gaze.joints:
                if joint in self.zero_force.joints:
                    yield "gaze", ("joints",), f"joint {joint!r} is in zero_force too", "Take it out of one"
