"""The table [drivers] of robot.toml."""

from __future__ import annotations

from typing import Annotated

import msgspec
from msgspec import Meta

from .dynamixel.config import DynamixelConfig

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
    """

    recording: str | None = None
    speed: NonNegative = 1.0
    recording_sigma_m: Positive | None = None
    dynamixel: DynamixelConfig | None = None
