"""The pairs that are doubted in a row, and whether they are the beginning of something new."""

from __future__ import annotations

from bodyschema.interfaces.records import FloatArray

from .gate import CHANGE, FEWEST_FOR_CHANGE, Gate
from .memory import PairMemory


class Doubts:
    """Counts the doubted pairs in a row, and keeps the newest of them: they may be the first of another era.

    Doubted pairs that stand alone are outliers. Nothing is learnt from them later, so they are not kept.
    """

    def __init__(self, joints: int) -> None:
        self._memory = PairMemory(joints, CHANGE)
        self._gate = Gate()

    @property
    def in_a_row(self) -> int:
        """How many pairs in a row have been doubted up to now."""
        return self._gate.in_a_row

    @property
    def changed(self) -> bool:
        """Whether so many are in a row that the world must have changed."""
        return self._gate.changed

    @property
    def perhaps_changed(self) -> bool:
        """Whether so many are in a row that it has, if one explanation fits them."""
        return self.in_a_row >= FEWEST_FOR_CHANGE

    def doubt(self, q: FloatArray, x: FloatArray, distance_m: float, limit_m: float) -> bool:
        """Whether to doubt the pair at q (d,), x (3,) that lies `distance_m` from its prediction."""
        doubted = self._gate.doubts(distance_m, limit_m)
        if doubted:
            self._memory.append(q[None], x[None])
        else:
            self._memory.clear()
        return doubted

    def run(self) -> tuple[FloatArray, FloatArray]:
        """The newest doubted pairs in a row, as many as make a change: q (n, d), x (n, 3)."""
        return self._memory.all()

    def restore(self, q: FloatArray, x: FloatArray, in_a_row: int) -> None:
        """Go on from the run q (n, d), x (n, 3), of which `in_a_row` were counted."""
        self._memory.restore(q, x, in_a_row)
        self._gate = Gate(in_a_row)
