"""The table [learner] of robot.toml."""

from __future__ import annotations

from typing import Annotated

import msgspec
from msgspec import Meta

from bodyschema.robot.toml_file import Count, Positive


class LearnerConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The table [learner]."""

    # how often stored samples are learnt again, on average, for every new one
    replays_per_pair: Annotated[float, Meta(ge=0, le=1000)] = 8.0
    # how many of the newest samples are kept for replay; the default takes 0.1 GB with seven joints
    replay_capacity: Annotated[int, Meta(ge=1, le=1_000_000)] = 20_000
    solve_every: Count = 25  # number of new samples after which the rigid chain and the exact map are solved again
    # how far the real arm may be from its description, 1-sigma: each component of a joint's axis, the zero of each
    # joint, and each component of the cameras' orientation
    angle_tolerance_deg: Positive = 3.0
    # the same for each coordinate of a joint's place, and for the zero of a sliding joint
    length_tolerance_m: Positive = 0.015
    # the same for each coordinate of the marker on the hand and of the cameras' place
    place_tolerance_m: Positive = 0.03
    checkpoint_every_s: Positive = 5.0  # time between checkpoints
