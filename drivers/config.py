"""The table [drivers] of robot.toml."""

from __future__ import annotations

import msgspec


class DriversConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The table [drivers]: where joint readings come from.

    Attributes:
        recording: a recording (CSV or Parquet) that stands in for the hardware, relative to robot.toml.
    """

    recording: str | None = None
