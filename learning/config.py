"""The table [learner] of robot.toml."""

from __future__ import annotations

from typing import Annotated

import msgspec
from msgspec import Meta

from bodyschema.robot.toml_file import Count, Positive


class LearnerConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The table [learner].

    Attributes:
        step_size: μ0 of the normalised LMS rule, between 0 and 2.
        replays_per_pair: how often stored pairs are learnt again, on average, for every new one.
        replay_capacity: how many of the newest pairs are kept for replay.
        solve_every: number of new pairs after which the rigid chain and the exact map are solved again.
        angle_tolerance_deg: how far the real arm may be from its description, 1-sigma: each component of a joint's
            axis, the zero of each joint, and each component of the cameras' orientation.
        length_tolerance_m: the same for each coordinate of a joint's place, and for the zero of a sliding joint.
        place_tolerance_m: the same for each coordinate of the marker on the hand and of the cameras' place.
        checkpoint_every_s: time between checkpoints.
        seed: of the replay's permutations.
    """

    step_size: Annotated[float, Meta(gt=0, lt=2)] = 0.5
    replays_per_pair: Annotated[float, Meta(ge=0, le=1000)] = 8.0
    replay_capacity: Annotated[int, Meta(ge=1, le=1_000_000)] = 20_000  # which take 0.1 GB with seven joints
    solve_every: Count = 25
    angle_tolerance_deg: Positive = 3.0
    length_tolerance_m: Positive = 0.015
    place_tolerance_m: Positive = 0.03
    checkpoint_every_s: Positive = 5.0
    seed: int = 0
