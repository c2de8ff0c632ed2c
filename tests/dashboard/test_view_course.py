"""The page's view of the course of learning and of the newest pairs."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
import pytest
from told_statuses import LEARNER

from bodyschema.daemon.transport.status import Change, LearnerStatus
from bodyschema.daemon.transport.wire import PredictReply
from bodyschema.dashboard.course import ChangeHistory, Series, _Settings
from bodyschema.dashboard.recent import RecentPairs, RecentSettings, cloud
from bodyschema.interfaces.errors import RequestError
from bodyschema.interfaces.records import Pair, frozen_array


def learner(pairs: int, **changed: Any) -> LearnerStatus:
    told = {"pairs": pairs, "last_seq": pairs, "pairs_since_change": pairs, "last_change": None} | changed
    return msgspec.structs.replace(LEARNER, **told)


def change(kind: str, *, noticed_seq: int = 105, found: bool = True) -> Change:
    return Change(
        first_seq=101, earliest_seq=100, latest_seq=102, noticed_seq=noticed_seq, found=found, kind=kind,
        probabilities={}, alike=None, moved_m=None, can_roll_back=True,
    )  # fmt: skip


def pair(seq: int, segment: int = 1) -> Pair:
    return Pair(
        store="2f9a",
        seq=seq,
        segment=segment,
        t=0.1 * seq,
        utc="2026-11-21T15:01:26+00:00",
        q=frozen_array([0.01 * seq, 0.0]),
        x=frozen_array([0.5, 0.001 * seq, 0.0]),
        cov=frozen_array(np.eye(3)),
    )


def test_series_of_months_stays_small_and_complete() -> None:
    series = Series()
    for t in range(100_000):
        series.add(float(t), error_m=0.001, expected_m=None, pairs_per_s=10.0, predict_s=None)
    t = series.document.t
    assert _Settings.largest_series / 4 < len(t) <= _Settings.largest_series
    assert t[0] < 1000 < 99_000 < t[-1]
    assert np.ptp(np.diff(t)) == 0


def test_change_is_marked_once_and_named_later() -> None:
    course = ChangeHistory()
    for pairs in (90, 100):
        course.note(learner(pairs), 1.0)
    for pairs in (101, 110, 200):
        last = change("undecided" if pairs < 200 else "camera")
        course.note(learner(pairs, pairs_since_change=pairs - 100, last_change=last), 2.0)
    assert [(mark.pairs, mark.kind) for mark in course.document.changes] == [(100, "camera")]


def marks(course: ChangeHistory) -> list[tuple[int, str | None, bool]]:
    return [(mark.pairs, mark.kind, mark.told) for mark in course.document.changes]


def test_a_told_tool_change_is_marked_as_told() -> None:
    course = ChangeHistory()
    told = change("tool", noticed_seq=100, found=False)
    for pairs in (100, 150):
        course.note(learner(pairs, pairs_since_change=pairs - 100, last_change=told), 1.0)
    assert marks(course) == [(100, "tool", True)]


def test_rolled_back_change_loses_its_mark() -> None:
    course = ChangeHistory()
    first, second = change("camera"), change("tool", noticed_seq=200, found=False)
    course.note(learner(110, pairs_since_change=10, last_change=first), 1.0)
    course.note(learner(210, pairs_since_change=10, last_change=second), 2.0)
    assert len(marks(course)) == 2
    course.note(learner(215, pairs_since_change=100, last_change=first), 3.0)
    assert marks(course) == [(100, "camera", False)]
    course.note(learner(216, pairs_since_change=216), 4.0)
    assert marks(course) == []


def test_relocated_change_is_marked_once() -> None:
    course = ChangeHistory()
    for since in (10, 12, 9):
        course.note(learner(110, pairs_since_change=since, last_change=change("camera")), 1.0)
    assert marks(course) == [(100, "camera", False)]


def test_model_span_is_one_line_with_newest_version() -> None:
    course = ChangeHistory()
    for pairs, answering, model in ((1, "nlms", "a"), (20, "nlms", "b"), (30, "rigid", "c"), (40, "rigid", "d")):
        course.note(learner(pairs, answering=answering, model=model), float(pairs))
    spans = [(span.answering, span.first_pairs, span.pairs, span.model) for span in course.document.versions]
    assert spans == [("nlms", 1, 20, "b"), ("rigid", 30, 40, "d")]


def test_a_tool_change_begins_another_span() -> None:
    course = ChangeHistory()
    course.note(learner(100), 1.0)
    course.note(learner(101, pairs_since_change=1), 2.0)
    assert [span.after_change for span in course.document.versions] == [False, True]


def test_learning_that_began_anew_has_no_past() -> None:
    course = ChangeHistory()
    course.note(learner(100, pairs_since_change=20), 1.0)
    course.note(learner(3, store="another"), 2.0)
    assert course.document.changes == []
    assert [span.first_pairs for span in course.document.versions] == [3]


def test_segment_counts_allow_an_unseen_beginning() -> None:
    recent = RecentPairs()
    recent.add([pair(seq, segment=4 + (seq > 12)) for seq in range(10, 20)])
    found = [(segment.segment, segment.pairs, segment.complete) for segment in recent.segments()]
    assert found == [(4, 3, False), (5, 7, True)]


def test_only_newest_pairs_of_store_are_kept() -> None:
    recent = RecentPairs()
    recent.add(pair(seq) for seq in range(1, 2 * RecentSettings.kept))
    assert (len(recent), recent.newest.seq) == (RecentSettings.kept, 2 * RecentSettings.kept - 1)


def test_cloud_is_even_sample_of_current_tool() -> None:
    recent = RecentPairs()
    recent.add(pair(seq) for seq in range(1, 2501))
    chosen = [chosen.seq for chosen in recent.chosen(500, 2400)]
    assert (len(chosen), chosen[0], chosen[-1]) == (RecentSettings.largest_cloud, 501, 2400)


def test_a_residual_is_measured_less_predicted() -> None:
    def predict(q: list[list[float]]) -> PredictReply:
        n = len(q)
        return PredictReply([[0.4, 0.0, 0.0]] * n, [[0.0] * 3] * n, [True] * n, "6b6f", 9, None)

    found = cloud([pair(2), pair(4)], predict)
    assert found.residual == [[0.1, 0.002, 0.0], [0.1, 0.004, 0.0]]
    assert found.model == "6b6f"


def test_cloud_without_model_is_empty() -> None:
    def refuse(q: list[list[float]]) -> PredictReply:
        raise RequestError("there is no model yet")

    assert cloud([pair(1)], refuse).x == []


def test_noise_is_at_most_the_best_model_s_error() -> None:
    assert LEARNER.calibration is not None
    bent = msgspec.structs.replace(LEARNER.calibration, noise_m=0.1)
    told = msgspec.structs.replace(LEARNER, calibration=bent)
    assert told.expected_error_m(0.0) == pytest.approx(0.002)
    assert msgspec.structs.replace(told, prequential_m={}).noise_m() == 0.1
    assert msgspec.structs.replace(told, calibration=None).expected_error_m(0.001) is None
