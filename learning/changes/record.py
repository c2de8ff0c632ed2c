"""Record of a change, and the part of the arm that it concerns."""

from __future__ import annotations

import msgspec

TOOL, CAMERA, JOINT = "tool", "camera", "joint"
# A kind at least this probable is named.
NAMED = 0.95
# A change is named or renamed within this many pairs; after them it stays as it is.
NAMED_WITHIN = 500


class KindOfChange(msgspec.Struct, frozen=True):
    """Kind of change with its probability."""

    name: str  # `tool`, `camera`, `joint` or `other`
    joint: int | None  # index of the joint (from 0) whose offset changed; None for other kinds
    probability: float  # of this kind


class ChangeRecord(msgspec.Struct, frozen=True, kw_only=True):
    """Last change."""

    first_seq: int  # sequence number of the most probable first pair after it
    # earliest_seq, latest_seq: 95 % interval of that number
    earliest_seq: int
    latest_seq: int
    noticed_seq: int  # the pair at which it was detected; of a reported change, the last one before it
    found: bool  # True if it was detected in the pairs, False if it was reported
    kinds: list[KindOfChange]  # possible kinds, the most probable first
    moved_m: float | None = None  # motion of the marker at the pairs since, root mean square [m]; None if unknown

    @property
    def named(self) -> KindOfChange | None:
        """Named kind; None while undecided. Kinds that no motion can separate count together."""
        best = self.kinds[0]
        same = [kind for kind in self.kinds[1:] if kind.name == self.alike(best) or self.alike(kind) == best.name]
        return best if best.probability + sum(kind.probability for kind in same) >= NAMED else None

    def alike(self, kind: KindOfChange) -> str | None:
        """Return the kind that no motion can separate from this one.

        An offset of the last joint equals a displacement of the marker; one of the first joint equals a turn of the
        camera.
        """
        joints = [each.joint for each in self.kinds if each.joint is not None]
        ends = {} if not joints else {0: CAMERA, max(joints): TOOL}
        return None if kind.joint is None else ends.get(kind.joint)

    @classmethod
    def told(cls, last_seq: int) -> ChangeRecord:
        """Return the record of a reported tool change after the pair `last_seq`."""
        first = last_seq + 1
        return cls(
            first_seq=first,
            earliest_seq=first,
            latest_seq=first,
            noticed_seq=last_seq,
            found=False,
            kinds=[KindOfChange(TOOL, None, 1.0)],
        )

    @classmethod
    def unnamed(cls, first_seq: int, noticed_seq: int, joints: int) -> ChangeRecord:
        """Return the record of a change detected when the arm was too poorly known to identify its kind."""
        zeros = [KindOfChange(JOINT, joint, 1.0 / (3.0 * joints)) for joint in range(joints)]
        return cls(
            first_seq=first_seq,
            earliest_seq=first_seq,
            latest_seq=first_seq,
            noticed_seq=noticed_seq,
            found=True,
            kinds=[KindOfChange(TOOL, None, 1.0 / 3.0), KindOfChange(CAMERA, None, 1.0 / 3.0), *zeros],
        )
