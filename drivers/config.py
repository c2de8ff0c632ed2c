"""The table [drivers] of robot.toml."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import msgspec
from msgspec import Meta

from interfaces.errors import ConfigError
from interfaces.toml_file import line_of

from .dynamixel.config import DynamixelConfig
from .ros2.config import Ros2Config

NonNegative = Annotated[float, Meta(ge=0)]
Positive = Annotated[float, Meta(gt=0)]


class DriversConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The table [drivers]: where joint readings come from.

    Attributes:
        recording: a recording (CSV or Parquet) that stands in for encoders and camera, relative to robot.toml.
        speed: how fast it is played: 1 as it was recorded, 2 twice as fast, 0 as fast as the sampler takes it.
        recording_sigma_m: 1-sigma per axis of its marker positions [m] where it has no columns for that. Without
            this key it comes from the stereo camera in [camera], or is 1 mm where there is none.
        dynamixel: the joints are Dynamixel servos.
        ros2: the joints are those of a ROS 2 robot.
    """

    recording: str | None = None
    speed: NonNegative = 1.0
    recording_sigma_m: Positive | None = None
    dynamixel: DynamixelConfig | None = None
    ros2: Ros2Config | None = None

    def check(self, joints: Sequence[str], file: Path, text: str) -> None:
        """ConfigError when two things give the joints, or one that does not fit `joints`."""
        if self.ros2 is not None:
            self.ros2.check(joints, file, text)
            if self.recording is not None and self.ros2.marker is None:  # with it the learner reads the joints
                line = line_of(text, ("drivers", "recording"))
                raise ConfigError(
                    "both a recording and ROS 2", file=file, line=line, remedy="Take one out of [drivers]"
                )
        if self.dynamixel is None:
            return
        if self.recording is not None:
            line = line_of(text, ("drivers", "recording"))
            raise ConfigError("both a recording and servos", file=file, line=line, remedy="Take one out of [drivers]")
        if self.ros2 is not None:
            line = line_of(text, ("drivers", "ros2"))
            raise ConfigError("both servos and ROS 2", file=file, line=line, remedy="Take one out of [drivers]")
        self.dynamixel.check(joints, file, text)
