"""The pairs that are doubted, and whether they are the beginning of something new."""

from __future__ import annotations

from interfaces.records import FloatArray

from .gate import CHANGE, FEWEST_FOR_CHANGE, Gate
from .memory import PairMemory

KEPT = 64


class Doubts:
    """Keeps the newest doubted pairs and counts those in a row."""

    def __init__(self, joints: int) -> None:
        self._memory = PairMemory(joints, KEPT)
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
        """Whether to doubt the pair at q (d,), x (3,) that lies `distance_m` from its prediction; if so it is kept."""
        doubted = self._gate.doubts(distance_m, limit_m)
        if doubted:
            self.set_aside(q, x)
        return doubted

    def set_aside(self, q: FloatArray, x: FloatArray) -> None:
        """Keep a pair that was doubted for another reason."""
        self._memory.append(q, x)

    def run(self) -> tuple[FloatArray, FloatArray]:
        """The newest doubted pairs in a row, as many as make a change: q (n, d), x (n, 3)."""
        q, x, _ = self._memory.since(self._memory.count - min(self.in_a_row, CHANGE))
        return q, x

    def all(self) -> tuple[FloatArray, FloatArray]:
        """All kept ones: q (n, d), x (n, 3)."""
        return self._memory.all()

    def clear(self) -> None:
        """Forget them."""
        self._memory.clear()
        self._gate = Gate()

    def restore(self, q: FloatArray, x: FloatArray, in_a_row: int) -> None:
        """Go on from these."""
        for row_q, row_x in zip(q, x, strict=True):
            self._memory.append(row_q, row_x)
        self._gate = Gate(in_a_row)
