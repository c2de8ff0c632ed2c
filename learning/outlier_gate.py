"""Runs of consecutive outliers, which may be the start of a changed arm or tool."""

from __future__ import annotations

from bodyschema.interfaces.records import FloatArray
from bodyschema.learning.outlier_limits import CHANGE, FEWEST_FOR_CHANGE, Gate
from bodyschema.learning.replay_memory import PairMemory


class OutlierGate:
    """Counts consecutive outliers, and keeps the newest of them: they may be the first pairs of another regime.

    Isolated outliers are never learnt later, so they are not kept.
    """

    def __init__(self, joints: int) -> None:
        self._memory = PairMemory(joints, CHANGE)
        self._gate = Gate()

    @property
    def in_a_row(self) -> int:
        """Number of consecutive outliers up to now."""
        return self._gate.in_a_row

    @property
    def changed(self) -> bool:
        """True if the run of outliers is long enough to prove a change."""
        return self._gate.changed

    @property
    def perhaps_changed(self) -> bool:
        """True if the run of outliers is long enough for a change, provided that one explanation fits them."""
        return self.in_a_row >= FEWEST_FOR_CHANGE

    def doubt(self, q: FloatArray, x: FloatArray, distance_m: float, limit_m: float) -> bool:
        """Return True if the pair at q (d,), x (3,), `distance_m` from its prediction, is an outlier."""
        doubted = self._gate.gate(distance_m, limit_m)
        if doubted:
            self._memory.append(q[None], x[None])
        else:
            self._memory.clear()
        return doubted

    def run(self) -> tuple[FloatArray, FloatArray]:
        """Return the newest consecutive outliers, at most as many as prove a change: q (n, d), x (n, 3)."""
        return self._memory.all()

    def restore(self, q: FloatArray, x: FloatArray, in_a_row: int) -> None:
        """Resume from the run q (n, d), x (n, 3), of which `in_a_row` were counted."""
        self._memory.restore(q, x, in_a_row)
        self._gate = Gate(in_a_row)
