"""Hold encoder readings in the order in which they were taken, as effects with memory require."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from bodyschema.interfaces.records import FloatArray, frozen_array
from bodyschema.recordings.recording import Recording
from kbmaps.rotations import exponentials


@dataclass(frozen=True, eq=False)
class Motion:
    """Readings of all encoders, one row per measurement."""

    q: FloatArray  # joint angles as read [rad] (m for a prismatic joint), shape (n, d)
    t: FloatArray | None  # increasing times [s], shape (n,); None if unknown
    segment: NDArray[np.int64]  # run numbers, shape (n,); the motion between two runs was not observed
    begun_at: float | None = None  # start of all drifts [s]; None for the first row
    # row numbers (n,) in a longer recording of which this is a part; None for a whole one
    rows: FloatArray | None = None

    @classmethod
    def of(cls, recording: Recording) -> Motion:
        """Return the motion of a recording; without a column `segment` it is one run."""
        segment = np.zeros(len(recording), dtype=np.int64) if recording.segment is None else recording.segment
        return cls(recording.q, None if recording.t is None else recording.play_times, segment)

    @classmethod
    def at(cls, q: FloatArray, t: float, begun_at: float | None = None) -> Motion:
        """Return a motion of one row: the readings q (d,) at the time t [s]."""
        return cls(q[None], np.array([t]), np.zeros(1, dtype=np.int64), begun_at)

    @classmethod
    def still(cls, q: FloatArray) -> Motion:
        """Return unrelated postures q (n, d) without times."""
        return cls(q, None, np.arange(len(q), dtype=np.int64))

    def some(self, rows: NDArray[np.intp]) -> Motion:
        """Return a part of the motion, at increasing rows (m,); a gap between them begins a new run."""
        segment = np.cumsum(self.begins[rows] | np.append(False, np.diff(rows) > 1), dtype=np.int64)
        return Motion(
            self.q[rows], None if self.t is None else self.t[rows], segment, self.begun_at, self.row_numbers[rows]
        )

    @property
    def row_numbers(self) -> FloatArray:
        """Number of each row (n,) in its recording."""
        return np.arange(len(self.q), dtype=np.float64) if self.rows is None else self.rows

    def __len__(self) -> int:
        return len(self.q)

    @property
    def joined(self) -> Motion:
        """The same readings as one run, as if the arm had gone straight from each run to the next."""
        return replace(self, segment=np.zeros_like(self.segment))

    @property
    def began(self) -> float:
        """Start of all drifts, by the `clock`."""
        return float(self.clock[0]) if self.begun_at is None else self.begun_at

    @property
    def clock(self) -> FloatArray:
        """Time of each row (n,): times [s], or row numbers without times."""
        return self.row_numbers if self.t is None else self.t

    @cached_property
    def begins(self) -> NDArray[np.bool_]:
        """True for rows that are the first of their run (n,)."""
        return np.append(True, self.segment[1:] != self.segment[:-1])

    @cached_property
    def moves(self) -> FloatArray:
        """Move that ended at each row (n, d) [rad, m]; 0 at the first row of a run."""
        moves = np.zeros_like(self.q)
        moves[1:] = np.diff(self.q, axis=0)
        moves[self.begins] = 0.0
        return frozen_array(moves)

    @cached_property
    def pace(self) -> FloatArray:
        """Time since the previous row (n,), as a multiple of the usual time; 1 at the start of a run."""
        usual = ~self.begins
        pace = np.ones(len(self.q))
        if usual.any():
            pace[1:] = np.diff(self.clock) / max(float(np.median(np.diff(self.clock)[usual[1:]])), 1e-12)
            pace[self.begins] = 1.0
        return frozen_array(pace)

    @cached_property
    def runs(self) -> list[tuple[int, int]]:
        firsts = np.flatnonzero(self.begins)
        return list(zip(firsts.tolist(), [*firsts[1:].tolist(), len(self.q)], strict=True))

    def before_travel(self, joint: int, travel: float) -> NDArray[np.bool_]:
        """Return rows (n,) before a joint has covered a range of `travel` [rad, m] in their run."""
        rows = np.zeros(len(self), dtype=np.bool_)
        for first, end in self.runs:
            q = self.q[first:end, joint]
            rows[first:end] = np.maximum.accumulate(q) - np.minimum.accumulate(q) < travel
        return rows

    @cached_property
    def cubics(self) -> FloatArray:
        """Path from each row to the next of its run (4, n, d): coefficients of powers of the time, highest first."""
        cubics = np.zeros((4, *self.q.shape))
        cubics[3] = self.q
        for first, end in self.runs:
            if end - first > 1:
                cubics[:3, first : end - 1] = _cubics(self.clock[first:end], self.q[first:end])
        return frozen_array(cubics)

    def earlier(self, lag_s: float | FloatArray) -> Motion:
        """Return the interpolated readings `lag_s` (a number or (n,)) before each row, without overshoot.

        Before the first row of a run, and after its last, the nearest rate continues. Single rows, and all rows without
        times, stay unchanged (Fritsch and Butland 1984).
        """
        if self.t is None:
            return self
        if isinstance(lag_s, np.ndarray):
            return _resampled(self, self.t - lag_s)
        return self if lag_s == 0.0 else _delayed(self, lag_s)


@lru_cache(maxsize=16)
def _delayed(motion: Motion, lag_s: float) -> Motion:
    """Return the earlier readings; cached, since a search repeats the same lags."""
    assert motion.t is not None
    return _resampled(motion, motion.t - lag_s)


def _resampled(motion: Motion, times: FloatArray) -> Motion:
    """Return the readings at the times `times` (n,), each from the run of its row."""
    assert motion.t is not None
    t, cubics = motion.t, motion.cubics
    lengths = [end - first for first, end in motion.runs]
    first, end = (np.repeat(rows, lengths) for rows in zip(*motion.runs, strict=True))
    inside = np.clip(times, t[first], t[end - 1])
    interval = np.clip(np.searchsorted(t, inside, side="right") - 1, first, np.maximum(end - 2, first))
    since = (inside - t[interval])[:, None]
    a, b, c, d = cubics[:, interval]
    rate = (3.0 * a * since + 2.0 * b) * since + c
    q = ((a * since + b) * since + c) * since + d + (times - inside)[:, None] * rate
    return Motion(frozen_array(q), motion.t, motion.segment, motion.begun_at)


def _cubics(t: FloatArray, q: FloatArray) -> FloatArray:
    """Return the highest three coefficients (3, m - 1, d) of a path through q (m, d) at times t (m,).

    It never overshoots: its rate at a reading is the harmonic mean of the adjacent slopes, and 0 at a reversal (Fritsch
    and Butland 1984).
    """
    gaps = np.diff(t)[:, None]
    slopes = np.diff(q, axis=0) / gaps
    rates = np.zeros_like(q)
    if len(gaps) == 1:
        rates[:] = slopes
    else:
        weight_before, weight_after = 2.0 * gaps[1:] + gaps[:-1], gaps[1:] + 2.0 * gaps[:-1]
        same_sign = slopes[:-1] * slopes[1:] > 0.0
        before, after = (np.where(same_sign, part, 1.0) for part in (slopes[:-1], slopes[1:]))
        rates[1:-1] = np.where(
            same_sign, (weight_before + weight_after) / (weight_before / before + weight_after / after), 0.0
        )
        for end, inner in ((0, 1), (-1, -2)):
            slope, next_one = slopes[end], slopes[inner]
            rate = ((2.0 * gaps[end] + gaps[inner]) * slope - gaps[end] * next_one) / (gaps[end] + gaps[inner])
            rate = np.where(rate * slope > 0.0, rate, 0.0)
            too_fast = (slope * next_one <= 0.0) & (np.abs(rate) > 3.0 * np.abs(slope))
            rates[end] = np.where(too_fast, 3.0 * slope, rate)
    bend = (rates[:-1] + rates[1:] - 2.0 * slopes) / gaps
    return np.stack([bend / gaps, (slopes - rates[:-1]) / gaps - bend, rates[:-1]])


def flanks(torque: FloatArray, hold: float, before: float = 0.0) -> FloatArray:
    """Return the flank of its backlash on which a joint rests (n,): 1 or -1, the sign of its torque.

    It changes sides when the opposite torque exceeds `hold`: until then friction in the gear keeps it in place.

    Args:
        torque: gravity's torque about the joint, in the order of the rows [N·m or N], shape (n,).
        hold: friction [N·m or N].
        before: flank before the first row; 0 if unknown, then the sign of the first torque counts.
    """
    sides = np.where(torque < 0.0, -1.0, 1.0)
    decided = np.abs(torque) > hold
    last = np.maximum.accumulate(np.where(decided, np.arange(len(torque)), -1))
    first = before or (float(sides[0]) if len(sides) else 0.0)
    return np.where(last >= 0, sides[np.maximum(last, 0)], first)


def transforms(values: FloatArray) -> FloatArray:
    """Return transforms (n, 4, 4) of shifts [m] and rotation vectors [rad] (n, 6)."""
    T = np.tile(np.eye(4), (len(values), 1, 1))
    T[:, :3, :3] = exponentials(values[:, 3:6])[0]
    T[:, :3, 3] = values[:, :3]
    return T


def rotation(values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the rotation (3, 3) of a pose's values (6, ...), and the rotation per change of its numbers (3, 3)."""
    turns, jacobians = exponentials(values[None, 3:6])
    return turns[0], jacobians[0]


def moved_and_turned(shifts: FloatArray, axes: FloatArray, lever: FloatArray) -> FloatArray:
    """Return moves (n, 3, 6) at levers (n, 3): shifts (n, 3, 3), and rotations about the columns of axes (n, 3, 3).

    Shifts and axes may be one (1, 3, 3) for all.
    """
    moves = np.empty((len(lever), 3, 6))
    moves[:, :, :3] = shifts
    moves[:, :, 3:] = crossed(axes, lever[:, :, None])
    return moves


def crossed(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return a × b (n, 3, p), of which either may be one for all rows or for all columns."""
    rows = [a[:, (k + 1) % 3] * b[:, (k + 2) % 3] - a[:, (k + 2) % 3] * b[:, (k + 1) % 3] for k in range(3)]
    return np.stack(rows, axis=1)


def moved_by_observer(values: FloatArray, x: FloatArray) -> FloatArray:
    """Return moves (n, 3, 6) of points x (n, 3) in an observer's frame, by the values (6, ...) of its pose."""
    turn, by_turn = rotation(values)
    axes = -turn.T[None]
    return moved_and_turned(axes, axes @ by_turn, x)
