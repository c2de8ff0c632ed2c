from __future__ import annotations

import logging

import numpy as np
import pytest
from board_renderer import webcams
from scripted_sources import Scripted
from shown_board import SIZE, known_rig

from bodyschema.daemon.sampler.reconnect import ReconnectingSource
from bodyschema.interfaces.errors import SourceError, SourceLost
from bodyschema.interfaces.records import JointReading, StereoFrame, frozen_array
from bodyschema.vision.rig.rectified import RectifiedCamera

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


def reopening(source: Scripted) -> ReconnectingSource[JointReading]:
    clock = SteppedClock()
    return ReconnectingSource(source, "the encoders", clock, clock.sleep)


def read_until_reading(source: ReconnectingSource[JointReading], timeout_s: float = 0.25) -> int:
    """Count the empty reads before the first that returns a reading."""
    for nothing in range(10_000):
        if source.read(timeout_s) is not None:
            return nothing
    raise AssertionError("no reading came")


def test_healthy_source_is_read_unchanged() -> None:
    with reopening(Scripted([READING])) as source:
        assert source.read(0.1) is READING


def test_the_first_opening_must_succeed() -> None:
    source = reopening(Scripted([], openings=[SourceError("no such device")]))
    with pytest.raises(SourceError, match="no such device"), source:
        pass


def test_lost_source_is_closed_and_reopened_after_wait() -> None:
    script = Scripted([SourceLost("unplugged"), READING])
    with reopening(script) as source:
        nothing = read_until_reading(source)
        assert (nothing, script.opened, script.closed) == (3, 2, 1)  # the loss, then 0.5 s in steps of 0.25


def test_the_waits_double_up_to_half_a_minute() -> None:
    failures = [SourceLost("still away")] * 8
    script = Scripted([SourceLost("unplugged"), READING], openings=[None, *failures])
    clock = SteppedClock()
    with ReconnectingSource(script, "the encoders", clock, clock.sleep) as source:
        read_until_reading(source)
    # Exact: the waits are 0.5, 1, 2, 4, 8, 16, and then 30 each.
    assert clock.t - 100.0 == pytest.approx(0.5 + 1 + 2 + 4 + 8 + 16 + 30 + 30 + 30)


def test_long_loss_is_logged_once(caplog) -> None:
    script = Scripted([SourceLost("unplugged"), READING], openings=[None, *[SourceLost("still away")] * 5])
    with reopening(script) as source, caplog.at_level(logging.WARNING):
        read_until_reading(source)
    assert [record.message for record in caplog.records] == [
        "the encoders are lost: unplugged; trying to open them again"
    ]


def test_unreadable_reopened_source_is_retried_with_growing_waits() -> None:
    clock, script = SteppedClock(), Scripted([*[SourceLost("dead")] * 5, READING])
    with ReconnectingSource(script, "the encoders", clock, clock.sleep) as source:
        read_until_reading(source)
    assert clock.t - 100.0 == pytest.approx(0.5 + 1 + 2 + 4 + 8)


def test_unreadable_reopened_source_is_not_logged_as_back(caplog) -> None:
    with reopening(Scripted([*[SourceLost("dead")] * 5, READING])) as source, caplog.at_level(logging.INFO):
        read_until_reading(source)
    assert [record.message for record in caplog.records] == [
        "the encoders are lost: dead; trying to open them again",
        "the encoders are back",
    ]


def test_trouble_is_reported_until_source_is_back() -> None:
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


def test_source_lost_at_the_end_is_closed_once() -> None:
    script = Scripted([SourceLost("unplugged")])
    with reopening(script) as source:
        source.read(0.1)
    assert script.closed == 1


def test_cheaply_probed_source_is_reopened_sooner() -> None:
    gone = SourceLost("unplugged", retry_s=0.2)
    script = Scripted([gone, READING], openings=[None, *[gone] * 20])
    clock = SteppedClock()
    with ReconnectingSource(script, "the encoders", clock, clock.sleep) as source:
        read_until_reading(source)
    assert clock.t == pytest.approx(100.0 + 21 * 0.2)


def test_device_forbidden_to_this_process_raises_source_error() -> None:
    clock = SteppedClock()
    script = Scripted([SourceLost("unplugged"), READING], openings=[None, SourceLost("not permitted")])
    source = ReconnectingSource(script, "the encoders", clock, clock.sleep, forbidden=lambda: "/dev/ttyUSB1")
    with source, pytest.raises(SourceError, match="/dev/ttyUSB1 came back as another device, which only a new start"):
        read_until_reading(source)


# --- other cameras are plugged in


class Exchanged:
    """Cameras lost after one frame; serials and image size of the replacement are given for each opening."""

    def __init__(self, plugged: list[tuple[tuple[str, str], tuple[int, int]]]) -> None:
        self._plugged, self._frames = iter(plugged), 0
        self.serials, self.image_size_px = ("", ""), SIZE
        self.closed = 0

    def __enter__(self):
        self.serials, self.image_size_px = next(self._plugged)
        return self

    def __exit__(self, *_) -> None:
        self.closed += 1

    def read(self, timeout_s: float) -> StereoFrame:
        self._frames += 1
        if self._frames == 2:
            raise SourceLost("unplugged")
        image = np.zeros((self.image_size_px[1], self.image_size_px[0], 3), np.uint8)
        return StereoFrame(float(self._frames), image, image)


@pytest.mark.parametrize(
    ("other", "said"),
    [
        ((("A1", "C3"), SIZE), "the right camera is C3, calibrated was B2"),
        ((("B2", "A1"), SIZE), "left and right are exchanged"),
        ((("A1", "B2"), (320, 240)), "the cameras give images of 320x240, they were calibrated with 640x480"),
    ],
    ids=["another_serial", "exchanged", "another_size"],
)
def test_exchanged_cameras_are_reported_until_calibrated_ones_return(other, said, caplog) -> None:
    right = (("A1", "B2"), SIZE)
    eyes = Exchanged([right, other, other, right])
    camera = RectifiedCamera(eyes, known_rig(webcams(np.random.default_rng(6))))
    clock, troubles = SteppedClock(), set()
    with ReconnectingSource(camera, "the cameras", clock, clock.sleep) as source, caplog.at_level(logging.WARNING):
        assert source.read(0.1) is not None
        while source.read(0.25) is None:
            troubles.add(source.trouble)
        assert source.trouble is None
    assert any(f"the cameras are lost ({said}" in trouble for trouble in troubles)
    assert [said in record.message for record in caplog.records] == [False, True]
    assert eyes.closed == 4
