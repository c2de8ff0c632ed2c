"""History of learning since the page's process started."""

from __future__ import annotations

from bodyschema.daemon.transport.status import Change as LastChange
from bodyschema.daemon.transport.status import LearnerStatus

from .documents import Change, CourseDocument, OutlookDocument, SeriesDocument, Version


class _Settings:
    largest_series: int = 600  # figures
    largest_course: int = 50  # changes, and versions


class Series:
    """Figures over time, at most `largest_series`, evenly spread."""

    def __init__(self) -> None:
        self._rows: list[tuple[float, float | None, float | None, float | None, float | None]] = []
        self._stride, self._offered = 1, 0

    def add(
        self,
        t: float,
        *,
        error_m: float | None,
        expected_m: float | None,
        pairs_per_s: float | None,
        predict_s: float | None,
    ) -> None:
        """Add the figures at one time, as in `SeriesDocument`, unless the thinning skips them."""
        is_kept = self._offered % self._stride == 0
        self._offered += 1
        if not is_kept:
            return
        self._rows.append((t, error_m, expected_m, pairs_per_s, predict_s))
        if len(self._rows) > _Settings.largest_series:
            self._stride *= 2
            self._rows = self._rows[::2]

    @property
    def document(self) -> SeriesDocument:
        """All figures, by columns."""
        columns = [list(column) for column in zip(*self._rows, strict=True)] or [[] for _ in range(5)]
        return SeriesDocument(*columns)


class ChangeHistory:
    """History of changes and answering models, from the learner's successive states."""

    def __init__(self) -> None:
        self._changes: dict[tuple[int | None, int | None], Change] = {}
        self._versions: list[Version] = []
        self._store: str | None = None

    @property
    def document(self) -> CourseDocument:
        """History so far."""
        return CourseDocument(list(self._changes.values()), list(self._versions))

    def note(self, status: LearnerStatus, now: float) -> None:
        """Add the learner's status at this time, UTC [s since 1970]."""
        store_changed = self._versions and status.pairs < self._versions[-1].pairs
        if store_changed or status.store != self._store:
            self._changes, self._versions, self._store = {}, [], status.store
        changed = self._note_change(status, now)
        if status.model:
            self._note_version(status, now, changed=changed)

    def _note_change(self, status: LearnerStatus, now: float) -> bool:
        """Record the current change and forget later ones, which the learner has undone. Return True if it is new."""
        at, last = status.pairs - status.pairs_since_change, status.last_change
        key = (at, None) if last is None else (None, last.noticed_seq)
        if at <= 0:
            self._changes = {}
            return False
        if key in self._changes:
            keys = list(self._changes)
            self._changes = {each: self._changes[each] for each in keys[: keys.index(key) + 1]}
            self._changes[key] = _marked(last, self._changes[key].pairs, self._changes[key].t)
            return False
        before = [(each, mark) for each, mark in self._changes.items() if mark.pairs < at]
        self._changes = dict([*before, (key, _marked(last, at, now))][-_Settings.largest_course :])
        return True

    def _note_version(self, status: LearnerStatus, now: float, *, changed: bool) -> None:
        last = self._versions[-1] if self._versions else None
        goes_on = last is not None and last.answering == status.answering and not changed
        version = Version(
            since=last.since if goes_on and last else now,
            first_pairs=last.first_pairs if goes_on and last else status.pairs,
            pairs=status.pairs,
            answering=status.answering,
            model=status.model,
            error_m=status.prequential_m.get(status.answering),
            after_change=last.after_change if goes_on and last else changed,
        )
        earlier = self._versions[:-1] if goes_on else self._versions
        self._versions = [*earlier, version][-_Settings.largest_course :]


def _marked(last: LastChange | None, pairs: int, t: float) -> Change:
    return Change(pairs, t, None if last is None else last.kind, last is not None and not last.found)


def expected_outlook(status: LearnerStatus) -> OutlookDocument | None:
    """Return the learner's forecast as errors on new pairs; None without a forecast."""
    outlook = status.outlook
    if outlook is None or (now_m := status.expected_error_m(outlook.error_m)) is None:
        return None

    def expected(claimed: list[float]) -> list[float]:
        return [status.expected_error_m(each_m) or each_m for each_m in claimed]

    sentence = "Enough data to predict where the arm was. Where intervals are still wide, move to other poses."
    if not outlook.enough:
        more = outlook.best_motion_m != outlook.like_so_far_m
        sentence = f"More data would help{f'; {outlook.best_motion} gains most' if more else ''}."
    return OutlookDocument(
        sentence,
        outlook.pairs,
        now_m,
        outlook.further_pairs,
        expected(outlook.like_so_far_m),
        outlook.best_motion,
        expected(outlook.best_motion_m),
    )
