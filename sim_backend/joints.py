"""Convert drive positions to true joint angles and to encoder inputs.

The physics moves the drives. A drive's position is the joint angle that an encoder with only a joint offset would
imply. The effects (`effects`) compute the true joint angle from the reading, at every step of the physics.
"""

from __future__ import annotations

from collections import deque
from math import ceil

import numpy as np

from bodyschema.effects import Identity, LiveEncoders, Motion
from bodyschema.interfaces.records import FloatArray

from .truth import TrueRobot


class JointPaths:
    """Joint angles over time, for each step of the physics.

    With a positive camera latency, a frame shows the joints as they were earlier. With a negative one, the readings are
    those of an earlier time. Effects that depend on the last move use the move during the last frame interval. This is
    the move between successive pairs as long as every frame becomes a pair.

    Args:
        rate_hz: steps a second, a multiple of the frames.
        camera_hz: frames a second.
        begins: start time of drift, that of the first frame [s].
    """

    def __init__(self, truth: TrueRobot, rate_hz: int, camera_hz: int, *, begins: float) -> None:
        self._truth, self._begins = truth, begins
        latency = truth.beyond.latency_s
        self._late, self._early = max(latency, 0.0) * rate_hz, max(-latency, 0.0) * rate_hz
        self._frame_steps = rate_hz // camera_hz
        self._live = LiveEncoders(truth.beyond, self._frame_steps)
        longest = max(self._late + self._frame_steps, self._early)
        self._past: deque[FloatArray] = deque(maxlen=ceil(longest) + 3)
        self._t = 0.0
        self._unloaded = np.zeros(0)
        self._hung: dict[Identity, float] = {}

    @property
    def plain(self) -> bool:
        """True if the joints are at the drive positions: no effect moves them."""
        return not any(effect.kind.moves_joints for effect in self._truth.beyond.all_effects)

    def record(self, angles: FloatArray, t: float) -> None:
        """Record the drive positions `angles` (d,) [rad or m] at the time t [s], one step after the last record."""
        self._past.append(angles)
        self._t = t
        if not self.plain:
            q = self._ago(self._late)
            move = q - self._ago(self._late + self._frame_steps)
            offsets = self._truth.offsets
            self._unloaded = self._live.true_angles(q + offsets, t, move) - offsets

    @property
    def read(self) -> FloatArray:
        """Drive positions (d,) [rad or m] that the encoders sample now, without the joint offsets."""
        return self._ago(self._early)

    @property
    def seen(self) -> FloatArray:
        """True joint angles (d,) [rad or m] in a frame taken now."""
        if self.plain:
            return self._past[-1]
        return self._unloaded + self._truth.beyond.given_way(self._unloaded[None], self._hung)[0]

    @property
    def row(self) -> Motion:
        """Exact encoder readings at the time of a frame taken now, one row."""
        return Motion.at(self.read + self._truth.offsets, self._t, self._begins)

    def _ago(self, steps: float) -> FloatArray:
        """Return the drive positions `steps` steps ago, by a parabola through three steps; at first, the oldest."""
        if steps == 0.0:
            return self._past[-1]
        middle = min(max(round(steps), 1), len(self._past) - 2)
        if middle < 1 or steps > len(self._past) - 1:
            return self._past[0]
        after, at, before = (self._past[-1 - k] for k in (middle - 1, middle, middle + 1))
        s = steps - middle
        return at + 0.5 * s * (before - after) + 0.5 * s * s * (before - 2.0 * at + after)
