"""Make pairs from the paper's random walk, as seen by encoders and cameras, with the daemon's sampler."""

from __future__ import annotations

import tempfile
import threading
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np

from bodyschema.cli.terminal.screen import Say, quiet
from bodyschema.daemon.config import DaemonConfig
from bodyschema.daemon.sampler.sources import Sources
from bodyschema.interfaces.clock import SystemClock
from bodyschema.interfaces.records import FloatArray, JointReading, MarkerFix, frozen_array
from kbmaps import RigidChain

from .arm import configuration
from .sampling import sampled

# Standard deviation of the poses, normally distributed about zero [rad].
WALK_SIGMA = np.radians(22.0)
STEP_DEG = (1.0, 3.0)
_FRAME_S = 1 / 30
_FRAME_STEP = np.radians(1.0)
_COV = frozen_array(np.eye(3) * 1e-6)


class _Walk:
    """Metropolis steps through poses (d,) [rad]; two threads may read, each at its own pace."""

    def __init__(self, rng: np.random.Generator, joints: int, stretch: float) -> None:
        self._rng, self._step = rng, stretch * _FRAME_STEP / np.sqrt(joints)
        self._poses: list[FloatArray] = [np.zeros(joints)]
        self._growing = threading.Lock()

    def pose(self, frame: int) -> FloatArray:
        with self._growing:
            while len(self._poses) <= frame:
                pose = self._poses[-1]
                proposed = pose + self._step * self._rng.normal(size=pose.shape)
                accept = self._rng.random() < np.exp((pose @ pose - proposed @ proposed) / (2.0 * WALK_SIGMA**2))
                self._poses.append(proposed if accept else pose)
            return self._poses[frame]


class _Source:
    """Common part of both sources of a walk: frames are counted from the opening on."""

    def __init__(self, walk: _Walk) -> None:
        self._walk, self._frame = walk, 0

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...

    def _next(self) -> tuple[float, FloatArray]:
        self._frame += 1
        return self._frame * _FRAME_S, self._walk.pose(self._frame)


class _Encoders(_Source):
    """Exact readings, one per frame."""

    def __init__(self, walk: _Walk, joints: Sequence[str]) -> None:
        super().__init__(walk)
        self.joints = tuple(joints)

    def read(self, timeout_s: float) -> JointReading:  # noqa: ARG002 - there is always a reading
        t, q = self._next()
        return JointReading(t, frozen_array(q))


class _Marker(_Source):
    """Exact fixes; noise is added to the pairs, so that two noise levels can be learnt in the same poses."""

    def __init__(self, walk: _Walk, chain: RigidChain) -> None:
        super().__init__(walk)
        self._chain = chain

    def read(self, timeout_s: float) -> MarkerFix:  # noqa: ARG002 - there is always a fix
        t, q = self._next()
        return MarkerFix(t, frozen_array(self._chain.positions(q)), _COV)


def walk(
    rng: np.random.Generator, count: int, joints: Sequence[str], *, each_joint: bool = False, say: Say = quiet
) -> FloatArray:
    """Return a random walk (count, d) [rad] with normally distributed poses, in steps of 1° to 3°.

    The daemon's sampler decides which of its frames become pairs.

    Args:
        each_joint: 1° to 3° is the root mean square step of a joint, not the Euclidean norm over all joints.
        say: called with the number of pairs.
    """
    stretch = float(np.sqrt(len(joints))) if each_joint else 1.0
    rules = DaemonConfig(min_step_deg=stretch * STEP_DEG[0], max_step_deg=stretch * STEP_DEG[1])
    with tempfile.TemporaryDirectory(prefix="bodyschema_") as folder:
        config = configuration(joints, Path(folder), rules)
        steps = _Walk(rng.spawn(1)[0], len(joints), stretch)
        sources = Sources(_Encoders(steps, joints), _Marker(steps, config.robot.chain), SystemClock())
        return sampled(config, sources, count, say)[0]
