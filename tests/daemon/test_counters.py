from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from small_arm import write_small_arm

from bodyschema.daemon.sampler.counters import SamplerCounters, _Settings
from bodyschema.interfaces.clock import SystemClock
from bodyschema.interfaces.records import Reason
from bodyschema.interfaces.rejections import REMEDIES, WORDS, rejection_text
from bodyschema.robot.description import RobotDescription

Q = np.zeros(2)


@pytest.fixture
def tally(tmp_path: Path) -> SamplerCounters:
    return SamplerCounters(RobotDescription.load(write_small_arm(tmp_path)), SystemClock())


def refuse(tally: SamplerCounters, reason: Reason, count: int) -> None:
    for _ in range(count):
        tally.reject(reason)


@pytest.mark.parametrize("reason", Reason)
def test_every_reason_has_words_and_a_remedy(reason) -> None:
    assert WORDS[reason]
    assert REMEDIES[reason].endswith((".", "?"))


def test_unknown_reason_of_newer_version_is_shown() -> None:
    assert rejection_text("too_cold") == "too cold"


@pytest.mark.parametrize("reason", [Reason.NO_MARKER, Reason.EPIPOLAR, Reason.STALE, Reason.MOVING])
def test_frames_all_refused_name_reason_and_remedy(tally, reason) -> None:
    refuse(tally, reason, _Settings.min_frames)
    assert tally.complaints == [
        f"{_Settings.min_frames} of the last {_Settings.min_frames} frames were rejected: {WORDS[reason]}. "
        f"{REMEDIES[reason]}"
    ]


def test_the_most_frequent_of_several_reasons_is_named(tally) -> None:
    refuse(tally, Reason.OCCLUDED, 40)
    refuse(tally, Reason.EPIPOLAR, 50)
    tally.accept(Q)
    assert [sentence.partition(". ")[0] for sentence in tally.complaints] == [
        "50 of the last 91 frames were rejected: rows differ"
    ]


def test_few_frames_are_no_reason_to_complain(tally) -> None:
    refuse(tally, Reason.NO_MARKER, _Settings.min_frames - 1)
    assert tally.complaints == []


@pytest.mark.parametrize("reason", [Reason.TOO_NEAR, Reason.PAUSED])
def test_an_arm_that_stands_still_is_in_order(tally, reason) -> None:
    refuse(tally, reason, _Settings.newest_frames)
    assert tally.complaints == []


def test_pairs_end_the_complaint(tally) -> None:
    refuse(tally, Reason.NO_MARKER, _Settings.newest_frames)
    for _ in range(_Settings.newest_frames // 10):
        tally.accept(Q)
    assert tally.complaints
    tally.accept(Q)
    assert tally.complaints == []
