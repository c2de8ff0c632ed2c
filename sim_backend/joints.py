"""From where the drives stand to where the joints really are, and to what the encoders read.

The physics moves the drives: each stands where its joint would, were the encoder right but for its zero. The effects
(`effects`) say from what the encoders read where the joint really is: every step of the physics drives them.
"""

from __future__ import annotations

from collections import deque
from math import ceil

import numpy as np

from bodyschema.effects import LiveEncoders, Motion
from bodyschema.interfaces.records import FloatArray

from .truth import TrueRobot


class JointPaths:
    """The joints over time, step by step of the physics.

    A late time stamp shows as a frame of the past: it has the joints as they were. One that is early shows as readings
    of the past. What has not come to rest lags by a fraction of the move during the last frame's interval: so it is
    that of the last move between pairs as long as every frame becomes a pair; its memory is of the frame before.

    Args:
        rate_hz: steps a second, a multiple of the frames.
        camera_hz: frames a second.
        begins: when what drifts begins to: the time of the first frame [s].
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

    @property
    def plain(self) -> bool:
        """Whether the joints are where the drives are: no effect moves them."""
        return not any(
            effect.kind.encoder is not None or effect.name in ("joint_compliance", "camera_latency")
            for effect in self._truth.beyond.all_effects
        )

    def record(self, angles: FloatArray, t: float) -> None:
        """The drives stand at `angles` (d,) [rad or m] at the time t [s], a step after the last time."""
        self._past.append(angles)
        self._t = t
        if not self.plain:
            q = self._ago(self._late)
            move = q - self._ago(self._late + self._frame_steps)
            offsets = self._truth.offsets
            self._unloaded = self._live.true_angles(q + offsets, t, move) - offsets

    @property
    def read(self) -> FloatArray:
        """Where the drives stand in the encoders' eyes (d,) [rad or m], their zeros not counted."""
        return self._ago(self._early)

    @property
    def seen(self) -> FloatArray:
        """True joint angles (d,) [rad or m] in a frame that is taken now."""
        if self.plain:
            return self._past[-1]
        return self._unloaded + self._truth.beyond.given_way(self._unloaded[None])[0]

    @property
    def row(self) -> Motion:
        """What the encoders would read exactly at the time of a frame that is taken now, one row."""
        return Motion.at(self.read + self._truth.offsets, self._t, self._begins)

    def _ago(self, steps: float) -> FloatArray:
        """Where the drives stood so many steps ago, by the parabola through three steps; at first, where they began."""
        if steps == 0.0:
            return self._past[-1]
        middle = min(max(round(steps), 1), len(self._past) - 2)
        if middle < 1 or steps > len(self._past) - 1:
            return self._past[0]
        after, at, before = (self._past[-1 - k] for k in (middle - 1, middle, middle + 1))
        s = steps - middle
        return at + 0.5 * s * (before - after) + 0.5 * s * s * (before - 2.0 * at + after)
