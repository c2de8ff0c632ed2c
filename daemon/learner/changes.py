"""Report the last detected change in the log and in the status."""

from __future__ import annotations

import logging
from collections.abc import Sequence

from bodyschema.daemon.transport.status import UNDECIDED, Change
from bodyschema.learning.changes.record import JOINT, ChangeRecord, KindOfChange

log = logging.getLogger(__name__)

# Kinds less probable than this are not reported.
_TOLD = 0.01


class Changes:
    """Logs the learner's changes, in the robot's names. Not thread-safe.

    Args:
        joints: joint names.
        change: the last change that was already reported; None: there was none.
    """

    def __init__(self, joints: Sequence[str], change: ChangeRecord | None = None) -> None:
        self._joints, self._told = tuple(joints), change

    def note(self, change: ChangeRecord | None, *, rolled_back: bool = False) -> None:
        """Log what is new about the last change: its detection, its cause, its rollback."""
        was, self._told = self._told, change
        if rolled_back:
            log.info("rolled back to the model before %s", "the change" if was is None else f"pair {was.first_seq}")
        elif change is not None and (was is None or was.noticed_seq != change.noticed_seq):
            log.info("%s", self._sentence(change))
        elif change is not None and was is not None and self._name(was) != self._name(change):
            log.info("the change at pair %d is %s", change.first_seq, self._name(change))

    def status(self, change: ChangeRecord | None, *, can_roll_back: bool) -> Change | None:
        """Return the change for the status; None: there was none."""
        if change is None:
            return None
        return Change(
            first_seq=change.first_seq,
            earliest_seq=change.earliest_seq,
            latest_seq=change.latest_seq,
            noticed_seq=change.noticed_seq,
            found=change.found,
            kind=self._name(change),
            probabilities={
                self._of(kind): round(kind.probability, 3) for kind in change.kinds if kind.probability > _TOLD
            },
            alike=None if change.named is None else change.alike(change.named),
            moved_m=change.moved_m,
            can_roll_back=can_roll_back,
        )

    def _sentence(self, change: ChangeRecord) -> str:
        if not change.found:
            return f"tool changed before pair {change.first_seq}, as reported by the command tool_changed"
        moved = "" if change.moved_m is None else f", marker moved by {1e3 * change.moved_m:.1f} mm"
        return (
            f"change found at pair {change.first_seq} ({change.earliest_seq} to {change.latest_seq}, noticed at "
            f"{change.noticed_seq}): {self._name(change)}{moved}"
        )

    def _name(self, change: ChangeRecord) -> str:
        return UNDECIDED if change.named is None else self._of(change.named)

    def _of(self, kind: KindOfChange) -> str:
        return kind.name if kind.joint is None else f"{JOINT} {self._joints[kind.joint]}"
