"""Ways to read a recording's columns: order, signs, offsets and units of the joints, positions and quaternions."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bodyschema.interfaces.records import FloatArray

from .limits import UNITS_PER_METRE

METRES = "metres"
QUARTER = math.pi / 2.0
# A joint offset this near to a quarter turn counts as one: assembled arms are off by less.
NEAR_RAD = math.radians(12.0)


@dataclass(frozen=True, slots=True)
class Reading:
    """One way to read the columns; all defaults except the order leave them unchanged.

    A joint is its column times its sign, plus its quarter turns, plus the angle of the previous joint if its column
    lacks it.
    """

    order: tuple[int, ...]  # index of the column of each joint
    signs: tuple[int, ...]  # 1 or -1 for each joint
    quarters: tuple[int, ...]  # quarter turns to add to each joint, 2 to -1
    mirrored: bool = False  # the positions are given in a left-handed frame
    unit: str = METRES  # of the positions
    degrees: bool = False  # the angles are in degrees
    millimetres: bool = False  # the readings of prismatic joints are in millimetres
    # 1 or -1 for a joint whose column lacks the previous joint's angle, or contains it twice; otherwise 0. This occurs
    # for arms whose elbow counts from the horizontal, as behind a parallelogram. Empty if no joint does.
    carried: tuple[int, ...] = ()

    @classmethod
    def plain(cls, joints: int) -> Reading:
        return cls(tuple(range(joints)), (1,) * joints, (0,) * joints)

    @property
    def scale(self) -> float:
        """Divisor that converts positions to metres."""
        return UNITS_PER_METRE.get(self.unit, 1.0)

    def angles(self, q: FloatArray, slides: NDArray[np.bool_]) -> FloatArray:
        """Return joint angles (n, d) [rad, m] of the columns q (n, d)."""
        units = np.where(slides, 1e-3 if self.millimetres else 1.0, math.radians(1.0) if self.degrees else 1.0)
        angles = (q[:, self.order] * units) * np.array(self.signs) + QUARTER * np.array(self.quarters)
        for joint, times in enumerate(self.carried):
            if times:
                angles[:, joint] += times * angles[:, joint - 1]
        return angles

    def positions(self, x: FloatArray) -> FloatArray:
        """Return positions (n, 3) [m] of the columns x (n, 3)."""
        return x * np.array([-1.0 if self.mirrored else 1.0, 1.0, 1.0]) / self.scale

    def turned(self, quarters: Sequence[int]) -> Reading:
        """Return the reading with these quarter turns added (d,)."""
        both = zip(self.quarters, quarters, strict=True)
        return replace(self, quarters=tuple((own + more + 1) % 4 - 1 for own, more in both))

    def neighbours(self, slides: Sequence[bool]) -> Iterator[Reading]:
        """Yield all readings with one more change.

        Args:
            slides: True for each joint (d,) that is prismatic: it has no quarter turns.
        """
        joints = range(len(self.order))
        for k in joints:
            yield self._with_sign(k)
        yield from self._turnings(slides)
        yield from (self._exchanged(j, k) for j, k in itertools.combinations(joints, 2))
        yield replace(self, signs=tuple(-sign for sign in self.signs))
        yield replace(self, mirrored=not self.mirrored)
        if self.unit == METRES:
            yield from (replace(self, unit=unit) for unit in UNITS_PER_METRE)
        yield replace(self, degrees=not self.degrees)
        if any(slides):
            yield replace(self, millimetres=not self.millimetres)

    def carrying(self, joint: int) -> Iterator[Reading]:
        """Yield the readings in which the column of a joint lacks the previous joint's angle, or contains it twice."""
        for times in (1, -1):
            yield replace(self, carried=tuple(times * (k == joint) for k in range(len(self.order))))

    def doubles(self, slides: Sequence[bool]) -> Iterator[Reading]:
        """Yield all readings with two more signs, or two more quarter turns: one alone may not improve the fit."""
        joints = range(len(self.order))
        for j, k in itertools.combinations(joints, 2):
            yield replace(self, signs=_replaced(self.signs, {j: -self.signs[j], k: -self.signs[k]}))
        turning = [k for k in joints[1:-1] if not slides[k]]
        for j, k in itertools.combinations(turning, 2):
            for turns, others in itertools.product((1, -1, 2), repeat=2):
                yield self.turned([turns * (i == j) + others * (i == k) for i in joints])

    def mixed(self, slides: Sequence[bool]) -> Iterator[Reading]:
        """Yield all readings with one more sign and one more quarter turn."""
        for k in range(len(self.order)):
            yield from self._with_sign(k)._turnings(slides)

    def mixed_exchanges(self, slides: Sequence[bool]) -> Iterator[Reading]:
        """Yield all readings with two columns exchanged, and one more sign or quarter turn."""
        joints = range(len(self.order))
        for j, k in itertools.combinations(joints, 2):
            reading = self._exchanged(j, k)
            yield from (reading._with_sign(i) for i in joints)
            yield from reading._turnings(slides)

    @property
    def changes(self) -> int:
        """Number of changes from the given columns; reversing all signs together counts as one."""
        moved, turned = sum(k != column for k, column in enumerate(self.order)), self.signs.count(-1)
        return (
            max(moved - 1, 0)
            + (turned if turned < len(self.signs) else 1)
            + sum(map(bool, (*self.quarters, *self.carried)))
            + sum((self.mirrored, self.unit != METRES, self.degrees, self.millimetres))
        )

    def label(self, joints: Sequence[str], zeros: FloatArray) -> str:
        """Return the changes in words, as in `the columns q1 and q2 are exchanged`.

        Args:
            zeros: joint offsets (d,) besides the quarter turns [rad, m].
        """
        return _listed([label for label, _ in self._describe_changes(joints, zeros)])

    def remedy(self, joints: Sequence[str], zeros: FloatArray) -> str:
        """Return the remedy; arguments as in `label`."""
        remedies = "; ".join(remedy for _, remedy in self._describe_changes(joints, zeros))
        return f"{remedies[0].upper()}{remedies[1:]}"

    def _with_sign(self, k: int) -> Reading:
        return replace(self, signs=_replaced(self.signs, {k: -self.signs[k]}))

    def _turnings(self, slides: Sequence[bool]) -> Iterator[Reading]:
        """Yield readings with another quarter turn of one joint; camera and marker absorb the outer joints'."""
        joints = range(len(self.order))
        for k in joints[1:-1]:
            if not slides[k]:
                yield from (self.turned([turns * (j == k) for j in joints]) for turns in (1, -1, 2))

    def _exchanged(self, j: int, k: int) -> Reading:
        """Return the reading with the columns of the joints j and k exchanged, together with their signs."""
        return replace(
            self,
            order=_replaced(self.order, {j: self.order[k], k: self.order[j]}),
            signs=_replaced(self.signs, {j: self.signs[k], k: self.signs[j]}),
        )

    def _describe_changes(self, joints: Sequence[str], zeros: FloatArray) -> Iterator[tuple[str, str]]:
        moved = [k for k, column in enumerate(self.order) if column != k]
        names = _listed([joints[k] for k in moved]) if moved else ""
        if len(moved) == 2:
            yield f"the columns {names} are exchanged", f"exchange the names {names} in the recording's header"
        elif moved:
            order = ", ".join(joints[k] for k in sorted(moved, key=self.order.__getitem__))
            yield f"the columns {names} are in the order {order}", "name them in that order"
        other = [joint for joint, sign in zip(joints, self.signs, strict=True) if sign < 0]
        if other and len(other) == len(joints):
            yield "all joints count the other way", "multiply all joint columns by -1"
        elif other:
            verb, column = ("counts", "column") if len(other) == 1 else ("count", "columns")
            yield (
                f"{_listed(other)} {verb} the other way",
                f"multiply the {column} {_listed(other)} by -1, or set `direction` in robot.toml",
            )
        for before, joint, times in zip(joints, joints[1:], self.carried[1:], strict=False):
            if times:
                yield (
                    f"{joint} counts together with {before}, as where it is counted from the horizontal",
                    f"{'add' if times > 0 else 'subtract'} the angle of {before} {'to' if times > 0 else 'from'} the "
                    f"column {joint}",
                )
        for joint, quarters, zero in zip(joints, self.quarters, zeros, strict=True):
            if quarters:
                # An offset near a quarter turn counts as one, the rest as tolerance.
                degrees = 90 * quarters + (0 if abs(zero) < NEAR_RAD else round(math.degrees(zero)))
                yield (
                    f"the zero of {joint} is about {abs(degrees)}° off",
                    f"add {degrees:+d}° to the readings of {joint}, or set its zero",
                )
        if self.mirrored:
            yield (
                "the positions are mirrored (a left-handed frame: two of x, y, z exchanged, or one counting the other "
                "way)",
                "exchange the two columns, or multiply the one by -1",
            )
        if self.unit != METRES:
            yield f"x, y, z are in {self.unit}", f"divide x, y, z by {self.scale:g}"
        if self.degrees:
            yield "the angles are in degrees", "multiply the angles by π/180"
        if self.millimetres:
            yield "the sliding joints are in millimetres", "divide their columns by 1000"


def _replaced(values: tuple[int, ...], changes: dict[int, int]) -> tuple[int, ...]:
    return tuple(changes.get(k, value) for k, value in enumerate(values))


def _listed(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
