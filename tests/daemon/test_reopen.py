from __future__ import annotations

import logging

import pytest
from scripted_sources import Scripted

from daemon.reopen import Reopening
from interfaces.errors import SourceError, SourceLost
from interfaces.records import JointReading, frozen_array

READING = JointReading(1.0, frozen_array([0.0]))


class SteppedClock:
    """A clock that only sleeping moves."""

    def __init__(self) -> None:
        self.t = 100.0

    def now(self) -> float:
        return self.t

    def utc(self) -> str:
        return ""

    def sleep(self, seconds: float) -> None:
        self.t += seconds


def reopening(source: Scripted) -> Reopening[JointReading]:
    clock = SteppedClock()
    return Reopening(source, "the encoders", clock, clock.sleep)


def read_until_reading(source: Reopening[JointReading], timeout_s: float = 0.25) -> int:
    """How many reads gave nothing before the first that gave a reading."""
    for nothing in range(10_000):
        if source.read(timeout_s) is not None:
            return nothing
    raise AssertionError("no reading came")


def test_a_source_is_read_as_it_is_while_all_is_well() -> None:
    with reopening(Scripted([READING])) as source:
        assert source.read(0.1) is READING


def test_the_first_opening_must_succeed() -> None:
    source = reopening(Scripted([], openings=[SourceError("no such device")]))
    with pytest.raises(SourceError, match="no such device"), source:
        pass


def test_a_lost_source_is_closed_and_opened_again_after_a_wait() -> None:
    script = Scripted([SourceLost("unplugged"), READING])
    with reopening(script) as source:
        nothing = read_until_reading(source)
        assert (nothing, script.opened, script.closed) == (3, 2, 1)  # the loss, then 0.5 s in steps of 0.25


def test_the_waits_double_up_to_half_a_minute() -> None:
    failures = [SourceLost("still away")] * 8
    script = Scripted([SourceLost("unplugged"), READING], openings=[None, *failures])
    clock = SteppedClock()
    with Reopening(script, "the encoders", clock, clock.sleep) as source:
        read_until_reading(source)
    # Exact: the waits are 0.5, 1, 2, 4, 8, 16, and then 30 each.
    assert clock.t - 100.0 == pytest.approx(0.5 + 1 + 2 + 4 + 8 + 16 + 30 + 30 + 30)


def test_a_loss_is_logged_once_however_long_it_lasts(caplog) -> None:
    script = Scripted([SourceLost("unplugged"), READING], openings=[None, *[SourceLost("still away")] * 5])
    with reopening(script) as source, caplog.at_level(logging.WARNING):
        read_until_reading(source)
    assert [record.message for record in caplog.records] == [
        "the encoders are lost: unplugged; trying to open them again"
    ]


def test_a_source_that_opens_but_cannot_be_read_is_tried_less_and_less_often() -> None:
    clock, script = SteppedClock(), Scripted([*[SourceLost("dead")] * 5, READING])
    with Reopening(script, "the encoders", clock, clock.sleep) as source:
        read_until_reading(source)
    assert clock.t - 100.0 == pytest.approx(0.5 + 1 + 2 + 4 + 8)


def test_a_source_that_opens_but_cannot_be_read_is_not_called_back(caplog) -> None:
    with reopening(Scripted([*[SourceLost("dead")] * 5, READING])) as source, caplog.at_level(logging.INFO):
        read_until_reading(source)
    assert [record.message for record in caplog.records] == [
        "the encoders are lost: dead; trying to open them again",
        "the encoders are back",
    ]


def test_the_trouble_is_told_until_the_source_is_back() -> None:
    with reopening(Scripted([SourceLost("unplugged"), READING])) as source:
        source.read(0.1)
        assert source.trouble == "the encoders are lost (unplugged); trying to open them again"
        read_until_reading(source)
        assert source.trouble is None


def test_every_loss_is_counted() -> None:
    with reopening(Scripted([SourceLost("1"), READING, SourceLost("2"), READING])) as source:
        read_until_reading(source)
        read_until_reading(source)
        assert source.losses == 2


def test_a_source_that_is_lost_in_the_end_is_closed_once() -> None:
    script = Scripted([SourceLost("unplugged")])
    with reopening(script) as source:
        source.read(0.1)
    assert script.closed == 1


def test_a_source_that_can_be_looked_for_cheaply_is_opened_again_sooner() -> None:
    gone = SourceLost("unplugged", retry_s=0.2)
    script = Scripted([gone, READING], openings=[None, *[gone] * 20])
    clock = SteppedClock()
    with Reopening(script, "the encoders", clock, clock.sleep) as source:
        read_until_reading(source)
    assert clock.t == pytest.approx(100.0 + 21 * 0.2)
