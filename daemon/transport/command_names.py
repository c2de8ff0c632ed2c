"""Names of the commands that the sampler and the learner accept."""

from __future__ import annotations

from typing import Literal

CommandName = Literal[
    "pause",
    "resume",
    "reload",
    "accept_turns",
    "zero_force_on",
    "zero_force_off",
    "gaze_on",
    "gaze_off",
    "reset_to_prior",
    "tool_changed",
    "rollback",
    "checkpoint",
]
BOTHS: tuple[CommandName, ...] = ("pause", "resume", "reload")
SAMPLERS: tuple[CommandName, ...] = (*BOTHS, "accept_turns", "zero_force_on", "zero_force_off", "gaze_on", "gaze_off")
