"""The learner's reports of a change, in the log and in the status."""

from __future__ import annotations

import logging

import msgspec
import pytest

from bodyschema.daemon.learner.findings import Changes
from bodyschema.learning.status import ChangeRecord, KindOfChange

JOINTS = ("waist", "shoulder", "elbow")
UNDECIDED = ChangeRecord(
    first_seq=201,
    earliest_seq=199,
    latest_seq=202,
    noticed_seq=210,
    found=True,
    kinds=[
        KindOfChange("joint", 1, 0.6),
        KindOfChange("tool", None, 0.3),
        KindOfChange("camera", None, 0.1),
        KindOfChange("joint", 2, 0.0),
        KindOfChange("joint", 0, 0.0),
    ],
    moved_m=0.0121,
)
NAMED = msgspec.structs.replace(UNDECIDED, kinds=[KindOfChange("joint", 1, 0.97), KindOfChange("tool", None, 0.03)])


def logged(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [record.getMessage() for record in caplog.records]


@pytest.fixture
def changes(caplog: pytest.LogCaptureFixture) -> Changes:
    caplog.set_level(logging.INFO)
    return Changes(JOINTS)


def test_change_is_logged_once_detected_and_once_named(changes: Changes, caplog) -> None:
    for record in (None, UNDECIDED, UNDECIDED, NAMED, NAMED):
        changes.note(record)
    assert logged(caplog) == [
        "change found at sample 201 (199 to 202, noticed at 210): undecided, marker moved by 12.1 mm",
        "the change at sample 201 is joint shoulder",
    ]


def test_announced_change_is_logged_as_announced(changes: Changes, caplog) -> None:
    changes.note(ChangeRecord.reported(20))
    assert logged(caplog) == ["tool changed before sample 21, as reported by the command tool_changed"]


def test_a_rollback_is_logged(changes: Changes, caplog) -> None:
    changes.note(UNDECIDED)
    changes.note(None, rolled_back=True)
    assert logged(caplog)[-1] == "rolled back to the model before sample 201"


def test_change_logged_before_restart_is_not_logged_again(caplog) -> None:
    caplog.set_level(logging.INFO)
    Changes(JOINTS, UNDECIDED).note(UNDECIDED)
    assert logged(caplog) == []


def test_the_status_names_joints_as_the_robot_does(changes: Changes) -> None:
    status = changes.status(NAMED, can_roll_back=True)
    assert status is not None
    assert (status.kind, status.probabilities) == ("joint shoulder", {"joint shoulder": 0.97, "tool": 0.03})


@pytest.mark.parametrize(("joint", "alike"), [(0, "camera"), (1, None), (2, "tool")])
def test_end_joint_offsets_resemble_camera_or_tool_change(changes: Changes, joint: int, alike: str | None) -> None:
    others = [KindOfChange("joint", k, 0.0) for k in range(3) if k != joint]
    record = msgspec.structs.replace(NAMED, kinds=[KindOfChange("joint", joint, 0.97), *others])
    status = changes.status(record, can_roll_back=True)
    assert status is not None
    assert status.alike == alike


def test_last_joint_is_named_despite_similar_tool() -> None:
    record = msgspec.structs.replace(
        UNDECIDED,
        kinds=[KindOfChange("joint", 2, 0.6), KindOfChange("tool", None, 0.39), KindOfChange("joint", 0, 0.0)],
    )
    assert record.named == KindOfChange("joint", 2, 0.6)


def test_tool_is_named_despite_similar_last_joint_offset() -> None:
    record = msgspec.structs.replace(
        UNDECIDED,
        kinds=[KindOfChange("tool", None, 0.6), KindOfChange("joint", 2, 0.39), KindOfChange("joint", 0, 0.0)],
    )
    assert record.named == KindOfChange("tool", None, 0.6)
