"""Encoder readings in the order in which they were taken: what an effect with a memory has to know."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from interfaces.recording import Recording
from interfaces.records import FloatArray, frozen_array


@dataclass(frozen=True, eq=False)
class Motion:
    """Readings of all encoders, one row a measurement.

    Attributes:
        q: joint angles as read [rad] (m for a prismatic joint), shape (n, d).
        t: increasing times [s], shape (n,); None when nothing is known of them.
        segment: numbers of the runs, shape (n,): what lies between two of them was not seen.
        begun_at: when whatever drifts began to [s]; None: at the first row.
    """

    q: FloatArray
    t: FloatArray | None
    segment: NDArray[np.int64]
    begun_at: float | None = None

    @classmethod
    def of(cls, recording: Recording) -> Motion:
        """The motion of a recording; without a column `segment` it is one run."""
        segment = np.zeros(len(recording), dtype=np.int64) if recording.segment is None else recording.segment
        return cls(recording.q, None if recording.t is None else recording.play_times, segment)

    @classmethod
    def at(cls, q: FloatArray, t: float, begun_at: float | None = None) -> Motion:
        """One row: the readings q (d,) at the time t [s]."""
        return cls(q[None], np.array([t]), np.zeros(1, dtype=np.int64), begun_at)

    def __len__(self) -> int:
        return len(self.q)

    @property
    def began(self) -> float:
        """When whatever drifts began to, by the `clock`."""
        return float(self.clock[0]) if self.begun_at is None else self.begun_at

    @property
    def clock(self) -> FloatArray:
        """When each row was measured (n,): times [s], or the numbers of the rows where there are none."""
        return np.arange(len(self.q), dtype=np.float64) if self.t is None else self.t

    @cached_property
    def begins(self) -> NDArray[np.bool_]:
        """Which rows are the first of their run (n,)."""
        return np.append(True, self.segment[1:] != self.segment[:-1])

    @cached_property
    def moves(self) -> FloatArray:
        """The move that ended at each row (n, d) [rad, m]; none at the first of a run."""
        moves = np.zeros_like(self.q)
        moves[1:] = np.diff(self.q, axis=0)
        moves[self.begins] = 0.0
        return frozen_array(moves)

    @cached_property
    def rates(self) -> FloatArray:
        """How fast the readings change at each row (n, d) [rad/s, m/s]: the parabola through it and its neighbours.

        Rows that stand alone, and all rows without times, have none.
        """
        rates = np.zeros_like(self.q)
        if self.t is None:
            return rates
        for first, end in self.runs:
            if end - first >= 2:
                edge_order = 2 if end - first > 2 else 1
                rates[first:end] = np.gradient(self.q[first:end], self.t[first:end], axis=0, edge_order=edge_order)
        return frozen_array(rates)

    @cached_property
    def runs(self) -> list[tuple[int, int]]:
        """First row of each run and the row after its last."""
        firsts = np.flatnonzero(self.begins)
        return list(zip(firsts.tolist(), [*firsts[1:].tolist(), len(self.q)], strict=True))

    def earlier(self, lag_s: float) -> Motion:
        """The readings that the encoders gave `lag_s` before each row, to second order in the lag."""
        if lag_s == 0.0 or self.t is None:
            return self
        q = self.q - lag_s * self.rates + 0.5 * lag_s**2 * self._bends
        return Motion(frozen_array(q), self.t, self.segment, self.begun_at)

    @cached_property
    def _bends(self) -> FloatArray:
        bends = np.zeros_like(self.q)
        assert self.t is not None
        for first, end in self.runs:
            if end - first >= 3:
                bends[first:end] = np.gradient(self.rates[first:end], self.t[first:end], axis=0)
        return bends
