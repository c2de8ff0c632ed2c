"""What is said of a change, and which part of the arm it leaves known."""

from __future__ import annotations

import msgspec

TOOL, CAMERA, JOINT = "tool", "camera", "joint"
# A kind that is so probable is named.
NAMED = 0.95
# A change is named, or named otherwise, within so many pairs; after them what is open stays open.
NAMED_WITHIN = 500


class KindOfChange(msgspec.Struct, frozen=True):
    """One kind of change and its probability.

    Attributes:
        name: `tool`, `camera`, `joint` or `other`.
        joint: which joint's zero (from 0); None where it is no joint's.
        probability: that it is this one.
    """

    name: str
    joint: int | None
    probability: float


class ChangeRecord(msgspec.Struct, frozen=True, kw_only=True):
    """The last change.

    Attributes:
        first_seq: sequence number of the most probable first pair after it.
        earliest_seq, latest_seq: between which that pair is, with 95 % probability.
        noticed_seq: the pair with which it was noticed; of a change that was told, the last one before it.
        found: in the pairs; else it was told.
        kinds: what it may be, the most probable first.
        moved_m: by how much it moved the marker at the pairs since, root mean square [m]; None where nobody knows.
    """

    first_seq: int
    earliest_seq: int
    latest_seq: int
    noticed_seq: int
    found: bool
    kinds: list[KindOfChange]
    moved_m: float | None = None

    @property
    def named(self) -> KindOfChange | None:
        """What it is; None while that is not decided. What no motion tells from it counts with it."""
        best = self.kinds[0]
        same = [kind for kind in self.kinds[1:] if kind.name == self.alike(best) or self.alike(kind) == best.name]
        return best if best.probability + sum(kind.probability for kind in same) >= NAMED else None

    def alike(self, kind: KindOfChange) -> str | None:
        """The kind that no motion tells from this one.

        The last joint's zero moves the marker on the hand, the first one's turns all that the camera sees.
        """
        joints = [each.joint for each in self.kinds if each.joint is not None]
        ends = {} if not joints else {0: CAMERA, max(joints): TOOL}
        return None if kind.joint is None else ends.get(kind.joint)

    @classmethod
    def told(cls, last_seq: int) -> ChangeRecord:
        """Of the tool, after the pair `last_seq`."""
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
        """One that was found when too little was known of the arm to tell what it was."""
        zeros = [KindOfChange(JOINT, joint, 1.0 / (3.0 * joints)) for joint in range(joints)]
        return cls(
            first_seq=first_seq,
            earliest_seq=first_seq,
            latest_seq=first_seq,
            noticed_seq=noticed_seq,
            found=True,
            kinds=[KindOfChange(TOOL, None, 1.0 / 3.0), KindOfChange(CAMERA, None, 1.0 / 3.0), *zeros],
        )
