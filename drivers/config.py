"""The table [drivers] of robot.toml."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import msgspec

from bodyschema.interfaces.errors import ConfigError
from bodyschema.robot.plugins import PluginConfig
from bodyschema.robot.toml_file import NonNegative, Positive, line_of

from .dynamixel.config import DynamixelConfig
from .feetech.config import FeetechConfig
from .markers.config import TABLE as MARKER_SOURCE
from .markers.config import AnySource, source_tables
from .ros2.config import Ros2Config
from .serial_lines.config import SerialLinesConfig

__all__ = ["HARDWARE", "MARKER_SOURCE", "AnySource", "DriversConfig", "source_tables"]


HARDWARE = {
    "dynamixel": "servos",
    "feetech": "servos",
    "serial_lines": "encoders",
    "ros2": "ROS 2",
    "plugin": "a plugin",
}


class DriversConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The table [drivers]: the source of joint readings."""

    # a recording (CSV or Parquet) that stands in for encoders and camera, relative to robot.toml
    recording: str | None = None
    # how fast it is played: 1 as it was recorded, 2 twice as fast, 0 as fast as the sampler takes it
    speed: NonNegative = 1.0
    # 1-sigma per axis of its marker positions [m] where it has no columns for that. Without this key it comes from the
    # stereo camera in [camera], or is 1 mm where there is none.
    recording_sigma_m: Positive | None = None
    dynamixel: DynamixelConfig | None = None  # the joints are Dynamixel servos
    feetech: FeetechConfig | None = None  # the joints are Feetech servos
    serial_lines: SerialLinesConfig | None = None  # the joints have encoders of their own, on a microcontroller
    ros2: Ros2Config | None = None  # the joints are those of a ROS 2 robot
    plugin: PluginConfig | None = None  # a driver of another package reads them

    @property
    def hardware(self) -> DynamixelConfig | FeetechConfig | SerialLinesConfig | Ros2Config | PluginConfig | None:
        """Configuration of the hardware that provides the joint readings, if any."""
        return self.dynamixel or self.feetech or self.serial_lines or self.ros2 or self.plugin

    def check(self, joints: Sequence[str], file: Path, text: str) -> None:
        """Raise ConfigError if two sources provide the joints, or if the source does not fit `joints`."""
        given = [name for name in HARDWARE if getattr(self, name) is not None]
        if len(given) > 1:
            line = line_of(text, ("drivers", given[1]))
            what = f"the joints cannot come from both {given[0]} and {given[1]}"
            raise ConfigError(what, file=file, line=line, remedy="Take one out of [drivers]")
        if self.hardware is None:
            return
        # The learner reads a ROS 2 robot's joints for its marker topic even when the samples come from elsewhere.
        if self.recording is not None and (self.ros2 is None or self.ros2.marker is None):
            line = line_of(text, ("drivers", "recording"))
            what = f"both a recording and {HARDWARE[given[0]]}"
            raise ConfigError(what, file=file, line=line, remedy="Take one out of [drivers]")
        self.hardware.check(joints, file, text)
