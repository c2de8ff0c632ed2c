"""Combine joint readings and marker positions with separate timestamps into a recording."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bodyschema.interfaces.errors import RecordingError
from bodyschema.interfaces.records import FloatArray

from .recording import Recording

log = logging.getLogger(__name__)


class _Settings:
    max_gap_s: float = 0.1  # between joint readings farther apart than this nothing is interpolated, as in the sampler
    # A pause between marker positions longer than this begins another segment, as in the sampler.
    segment_gap_s: float = 1.0
    # Rows whose interpolated joints are less sure than this are left out [rad, m]: the sampler's limit for late joints.
    max_sigma: float = np.radians(0.2)
    # A chord of the double interval misses its middle reading by four times what one of the single interval does.
    chord: float = 0.25


@dataclass(frozen=True, eq=False)
class JointTrack:
    t: FloatArray  # times (n,) [s]
    q: FloatArray  # (n, d) [rad, m]
    # number of the run of each reading (n,): nothing is interpolated between two runs, whose clocks differ
    run: NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class MarkerTrack:
    """Positions of the marker in the measurement frame."""

    t: FloatArray  # times (m,) on the clock of the joints [s]
    x: FloatArray  # (m, 3) [m]
    run: NDArray[np.int64]  # as in `JointTrack` (m,)
    cov: FloatArray | None = None  # covariances (m, 3, 3) [m²], or None
    orientation: FloatArray | None = None  # unit quaternions (m, 4), x, y, z, w, or None

    def earlier(self, delay_s: float) -> MarkerTrack:
        """Return the track with all times `delay_s` earlier, to correct positions that were stamped late."""
        return replace(self, t=self.t - delay_s)


def joined(names: tuple[str, ...], joints: JointTrack, marker: MarkerTrack, file: Path) -> Recording:
    """Return a recording with a row for each marker position that lies between two joint readings.

    The joints are interpolated linearly. The error is estimated by leaving out each reading in turn; rows whose error
    exceeds `max_sigma` are dropped, and counted in the log.

    Raises:
        RecordingError: no marker position lies between two joint readings.
    """
    parts: list[tuple[NDArray[np.int64], FloatArray, FloatArray]] = []
    for run in np.unique(marker.run):
        readings, rows = _ascending(joints.t, joints.run == run), _ascending(marker.t, marker.run == run)
        if len(readings) > 1:
            parts.append(_interpolated(joints.t[readings], joints.q[readings], marker.t, rows))
    if not any(len(rows) for rows, _, _ in parts):
        raise RecordingError(_apart(joints, marker), file=file, remedy="Record both with one clock, at the same time")
    rows = np.concatenate([rows for rows, _, _ in parts])
    q = np.concatenate([angles for _, angles, _ in parts])
    sigma = np.concatenate([sigma for _, _, sigma in parts])
    sure = sigma <= _Settings.max_sigma
    if not sure.any():
        raise RecordingError(
            f"the joints move too fast for how often they were read: {np.degrees(np.median(sigma)):.2g}° (1-sigma)",
            file=file,
            remedy="Record the joints more often, or move more slowly",
        )
    _tell(len(marker.t), len(rows), sure, sigma, file)
    rows, q = rows[sure], q[sure]
    begins = (np.diff(marker.run[rows]) != 0) | (np.diff(marker.t[rows]) > _Settings.segment_gap_s)
    return Recording(
        joints=names,
        q=q,
        x=marker.x[rows],
        t=marker.t[rows],
        cov=None if marker.cov is None else marker.cov[rows],
        orientation=None if marker.orientation is None else marker.orientation[rows],
        segment=np.concatenate([[0], np.cumsum(begins)]).astype(np.int64),
        file=file,
    )


def _ascending(t: FloatArray, chosen: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return the chosen rows in the order of time; of equal times only the first."""
    rows = np.flatnonzero(chosen)
    _, first = np.unique(t[rows], return_index=True)
    return rows[first]


def _interpolated(
    t: FloatArray, q: FloatArray, at: FloatArray, rows: NDArray[np.int64]
) -> tuple[NDArray[np.int64], FloatArray, FloatArray]:
    """Return those of `rows` that lie between two readings, the joints there, and the 1-sigma of the worst joint."""
    after = np.searchsorted(t, at[rows], side="left")
    exact = (after < len(t)) & (t[np.minimum(after, len(t) - 1)] == at[rows])
    after = np.where(exact & (after == 0), 1, after)
    between = (after > 0) & (after < len(t))
    after, rows = after[between], rows[between]
    near = t[after] - t[after - 1] <= _Settings.max_gap_s
    after, rows = after[near], rows[near]
    share = ((at[rows] - t[after - 1]) / (t[after] - t[after - 1]))[:, None]
    found = q[after - 1] + share * (q[after] - q[after - 1])
    bend = _bend(t, q)
    return rows, found, np.maximum(bend[after - 1], bend[after])


def _bend(t: FloatArray, q: FloatArray) -> FloatArray:
    """Return the error of the chord between neighbouring readings at each reading (n,)."""
    bend = np.zeros(len(t))
    if len(t) > 2:
        share = ((t[1:-1] - t[:-2]) / (t[2:] - t[:-2]))[:, None]
        bend[1:-1] = _Settings.chord * np.abs(q[:-2] + share * (q[2:] - q[:-2]) - q[1:-1]).max(axis=1)
    return bend


def _tell(positions: int, between: int, sure: NDArray[np.bool_], sigma: FloatArray, file: Path) -> None:
    if positions > between:
        log.warning(
            "%s: %d of %d marker positions have no joint readings around them", file, positions - between, positions
        )
    if not sure.all():
        log.warning("%s: %d rows are left out: the joints moved too fast to be interpolated", file, (~sure).sum())
    log.info("%s: joints interpolated to %.2g° (median, 1-sigma)", file, np.degrees(np.median(sigma)))


def _apart(joints: JointTrack, marker: MarkerTrack) -> str:
    return (
        f"no marker position lies between two joint readings at most {_Settings.max_gap_s:g} s apart: the joints are "
        f"from {joints.t.min():.3f} to {joints.t.max():.3f} s, "
        f"the marker from {marker.t.min():.3f} to {marker.t.max():.3f} s"
    )
