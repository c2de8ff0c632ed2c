"""The zenoh keys of one robot."""

from __future__ import annotations

from dataclasses import dataclass
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


@dataclass(frozen=True, slots=True)
class Keys:
    """Keys under `bodyschema/<robot name>/`."""

    robot: str

    def _key(self, name: str) -> str:
        return f"bodyschema/{self.robot}/{name}"

    @property
    def pair(self) -> str:
        """Publication of accepted pairs."""
        return self._key("pair")

    @property
    def pairs(self) -> str:
        """Stored pairs: `pairs?from=SEQ;to=SEQ`, answered by the sampler."""
        return self._key("pairs")

    @property
    def predict(self) -> str:
        """Joint angles to marker positions, answered by the learner."""
        return self._key("predict")

    @property
    def jacobian(self) -> str:
        """Joint angles to Jacobians, answered by the learner."""
        return self._key("jacobian")

    @property
    def ik(self) -> str:
        """Marker positions to joint angles, answered by the learner."""
        return self._key("ik")

    @property
    def model(self) -> str:
        """The model as one self-describing file, answered by the learner."""
        return self._key("model")

    @property
    def picture(self) -> str:
        """The cameras' newest picture with detections, answered by a sampler with cameras."""
        return self._key("picture")

    @property
    def simulation(self) -> str:
        """The simulated world: its ground truth and its tool; only with --sim, and never used for learning."""
        return self._key("simulation")

    def status(self, process: str) -> str:
        """Return the key for the state of `sampler` or `learner`, a publication and a queryable."""
        return self._key(f"status/{process}")

    def command(self, process: str) -> str:
        """Return the key for commands to `sampler` or `learner`."""
        return self._key(f"command/{process}")

    def alive(self, process: str) -> str:
        """Return the key of the liveliness token of `sampler` or `learner`."""
        return self._key(f"alive/{process}")
