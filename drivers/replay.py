"""Replay a recording in place of encoders and camera."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Self

import numpy as np

from bodyschema.interfaces.camera import StereoCalibration
from bodyschema.interfaces.clock import SystemClock
from bodyschema.interfaces.errors import SourceEnded, SourceError
from bodyschema.interfaces.records import FloatArray, JointReading, MarkerFix, frozen_array
from bodyschema.recordings.recording import Recording


class ReplaySettings:
    default_sigma_m: float = 1e-3  # of a recording without covariances
    rows_ahead: int = 8  # rows by which one source may lead the other


class Replay:
    """Player of a recording through a joint source and a marker source in lock step.

    At each row's time there is one joint reading and one fix, so that joint angles interpolated to the fix's time are
    exactly the row's. Neither source runs more than a few rows ahead of the other, however fast it is read.
    """

    def __init__(
        self,
        recording: Recording,
        *,
        speed: float = 1.0,  # 1 as recorded, 2 twice as fast; 0 as fast as it is read
        # 1-sigma per axis of the positions where the recording has no covariances [m]; None takes what `calibration`
        # says, and without that 1 mm
        sigma_m: float | None = None,
        calibration: StereoCalibration | None = None,
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        """Prepare the replay; it starts once both sources are entered and one is read."""
        self.t = recording.play_times  # times of the rows [s], shape (n,): `Recording.play_times`
        cov = recording.cov if recording.cov is not None else default_covariances(recording, sigma_m, calibration)
        self._pace = _Pace(self.t, speed, now)
        self.joints = ReplayJoints(recording, self.t, self._pace)
        self.marker = ReplayMarker(recording, self.t, cov, self._pace)
        self.clock = ReplayClock(self._pace)


class ReplayJoints:
    """The joint angles of a recording as a `JointSource`."""

    def __init__(self, recording: Recording, t: FloatArray, pace: _Pace) -> None:
        self._recording, self._t, self._pace = recording, t, pace

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the joints in the order of q."""
        return self._recording.joints

    def __enter__(self) -> Self:
        self._pace.open(_JOINTS)
        return self

    def __exit__(self, *_: object) -> None:
        self._pace.close(_JOINTS)

    def read(self, timeout_s: float) -> JointReading | None:
        """Return the next row's joint angles; see `JointSource.read`."""
        row = self._pace.next_row(_JOINTS, timeout_s)
        return None if row is None else JointReading(float(self._t[row]), frozen_array(self._recording.q[row]))


class ReplayMarker:
    """The marker positions of a recording, and its orientations if it has any, as a `MarkerSource`."""

    def __init__(self, recording: Recording, t: FloatArray, cov: FloatArray, pace: _Pace) -> None:
        self._recording, self._t, self._cov, self._pace = recording, t, cov, pace

    def __enter__(self) -> Self:
        self._pace.open(_MARKER)
        return self

    def __exit__(self, *_: object) -> None:
        self._pace.close(_MARKER)

    def read(self, timeout_s: float) -> MarkerFix | None:
        """Return the next row's marker position; see `MarkerSource.read`."""
        row = self._pace.next_row(_MARKER, timeout_s)
        if row is None:
            return None
        centres = None
        if self._recording.centres_px is not None:
            ul, vl, ur, vr = self._recording.centres_px[row].tolist()
            centres = (ul, vl, ur, vr)
        x, cov = frozen_array(self._recording.x[row]), frozen_array(self._cov[row])
        turns = self._recording.orientation
        R = None if turns is None else frozen_array(turns[row] / np.linalg.norm(turns[row]))
        return MarkerFix(float(self._t[row]), x, cov, centres, R=R)


class ReplayClock(SystemClock):
    """Clock with the recording's time; its wall-clock time is the machine's."""

    def __init__(self, pace: _Pace) -> None:
        self._pace = pace

    def now(self) -> float:
        """Return the time [s] of the newest fix played, or that of the first one before any was."""
        return self._pace.played_until(_MARKER)


def default_covariances(
    recording: Recording, sigma_m: float | None, calibration: StereoCalibration | None
) -> FloatArray:
    """Return covariances of the positions [m²], shape (n, 3, 3), for a recording without its own.

    Args:
        calibration: the stereo camera whose pixel noise determines them if `sigma_m` is None.
    """
    if sigma_m is None and calibration is not None and calibration.is_stereo and (recording.x[:, 2] > 0).all():
        return stereo_covariances(recording.x, calibration)
    sigma_m = ReplaySettings.default_sigma_m if sigma_m is None else sigma_m
    return np.broadcast_to(np.eye(3) * sigma_m**2, (len(recording), 3, 3))


def stereo_covariances(x: FloatArray, calibration: StereoCalibration) -> FloatArray:
    """Return covariances [m²], shape (n, 3, 3), of points x (n, 3) seen by a stereo camera, from its pixel noise."""
    depth = x[:, 2]
    scale = calibration.focal_px / depth
    J = np.zeros((len(x), 4, 3))  # derivative of (ul, vl, ur, vr) [px/m]
    J[:, 0, 0] = J[:, 2, 0] = J[:, 1, 1] = J[:, 3, 1] = scale
    J[:, 0, 2] = -scale * x[:, 0] / depth
    J[:, 1, 2] = J[:, 3, 2] = -scale * x[:, 1] / depth
    J[:, 2, 2] = -scale * (x[:, 0] - calibration.baseline_m) / depth
    information = J.swapaxes(1, 2) @ J / calibration.pixel_sigma**2
    return np.asarray(np.linalg.inv(information), dtype=np.float64)


_JOINTS, _MARKER = 0, 1


class _Pace:
    """Schedule of the next row for each of two readers."""

    def __init__(self, t: FloatArray, speed: float, now: Callable[[], float]) -> None:
        self._t, self._speed, self._now = t, speed, now
        self._turn = threading.Condition()
        self._next = [0, 0]
        self._is_open = [False, False]
        self._start: float | None = None

    def open(self, reader: int) -> None:
        with self._turn:
            self._is_open[reader] = True

    def close(self, reader: int) -> None:
        with self._turn:
            self._is_open[reader] = False
            self._turn.notify_all()

    def next_row(self, reader: int, timeout_s: float) -> int | None:
        """Return the reader's next row; None if its turn does not come within `timeout_s`."""
        with self._turn:
            if not self._is_open[reader]:
                raise SourceError("the recording is not open; use its sources in with statements")
            row = self._next[reader]
            if row == len(self._t):
                raise SourceEnded("the recording is through")
            if not self._wait(reader, row, timeout_s):
                return None
            self._next[reader] = row + 1
            self._turn.notify_all()
            return row

    def played_until(self, reader: int) -> float:
        """Return the time [s] of the newest row given to the reader, or that of the first one before any was."""
        with self._turn:
            return float(self._t[max(self._next[reader] - 1, 0)])

    def _wait(self, reader: int, row: int, timeout_s: float) -> bool:
        deadline = time.monotonic() + timeout_s
        if not self._turn.wait_for(lambda: row < self._next[1 - reader] + ReplaySettings.rows_ahead, timeout_s):
            return False
        if self._speed == 0:
            return True
        if self._start is None:
            self._start = self._now()
        due = self._start + (self._t[row] - self._t[0]) / self._speed
        while (early := due - self._now()) > 0:
            left = deadline - time.monotonic()
            if left <= 0:
                return False
            self._turn.wait(min(early, left))
        return True
