"""The zenoh keys of one robot."""

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


class Keys:
    """Keys under `bodyschema/<robot name>/`.

    Attributes:
        pair: publication of accepted pairs.
        pairs: stored pairs, `pairs?from=SEQ;to=SEQ`, answered by the sampler.
        predict: joint angles to marker positions, answered by the learner.
        jacobian: joint angles to Jacobians, answered by the learner.
        ik: marker positions to joint angles, answered by the learner.
        model: the model as one self-describing file, answered by the learner.
        picture: the cameras' newest picture with detections, answered by a sampler with cameras.
        simulation: the simulated world, its ground truth and its tool; only with --sim, and never used for learning.
    """

    def __init__(self, robot: str) -> None:
        self._prefix = f"bodyschema/{robot}"
        self.pair, self.pairs = f"{self._prefix}/pair", f"{self._prefix}/pairs"
        self.predict, self.jacobian = f"{self._prefix}/predict", f"{self._prefix}/jacobian"
        self.ik, self.model = f"{self._prefix}/ik", f"{self._prefix}/model"
        self.picture, self.simulation = f"{self._prefix}/picture", f"{self._prefix}/simulation"

    def status(self, process: str) -> str:
        """Return the key for the state of `sampler` or `learner`, a publication and a queryable."""
        return f"{self._prefix}/status/{process}"

    def command(self, process: str) -> str:
        """Return the key for commands to `sampler` or `learner`."""
        return f"{self._prefix}/command/{process}"

    def alive(self, process: str) -> str:
        """Return the key of the liveliness token of `sampler` or `learner`."""
        return f"{self._prefix}/alive/{process}"
