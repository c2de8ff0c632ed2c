from __future__ import annotations

import threading
from collections.abc import Callable

import numpy as np
import pytest

from bodyschema.drivers.replay import Replay, ReplaySettings
from bodyschema.interfaces.camera import StereoCalibration
from bodyschema.interfaces.errors import SourceEnded, SourceError
from bodyschema.interfaces.protocols import JointSource, MarkerSource
from bodyschema.interfaces.records import JointReading, MarkerFix
from bodyschema.recordings.recording import Recording, RecordingSettings

STEREO = StereoCalibration(
    focal_px=700.0, principal_point_px=(320.0, 240.0), baseline_m=0.2, image_size_px=(640, 480), pixel_sigma=0.2
)


class Hand:
    """A clock that is moved by hand."""

    def __init__(self) -> None:
        self.time = 100.0

    def __call__(self) -> float:
        return self.time


def recording(n: int = 5, **columns: object) -> Recording:
    rng = np.random.default_rng(7)
    x = rng.normal(size=(n, 3)) * 0.1 + [0, 0, 1]
    return Recording(("a", "b"), rng.normal(size=(n, 2)), x, **columns)  # pyright: ignore[reportArgumentType]


def drain(source: JointSource | MarkerSource) -> list[JointReading | MarkerFix]:
    taken = []
    while (item := source.read(0.0)) is not None:
        taken.append(item)
    return taken


def play(replay: Replay) -> tuple[list[JointReading], list[MarkerFix]]:
    readings, fixes = [], []
    with replay.joints as joints, replay.marker as marker:
        for _ in replay.t:
            readings.append(joints.read(0.0))
            fixes.append(marker.read(0.0))
    return readings, fixes


def test_both_sides_are_sources() -> None:
    replay = Replay(recording())
    assert isinstance(replay.joints, JointSource)
    assert isinstance(replay.marker, MarkerSource)


def test_each_row_yields_simultaneous_fix_and_reading() -> None:
    played = recording(20)
    readings, fixes = play(Replay(played, speed=0))
    assert [reading.t for reading in readings] == [fix.t for fix in fixes]
    assert [reading.q.tolist() for reading in readings] == played.q.tolist()
    assert [fix.x.tolist() for fix in fixes] == played.x.tolist()


def test_the_recordings_own_times_and_covariances_are_played() -> None:
    cov = np.eye(3)[None] * np.array([1.0, 2.0, 3.0])[:, None, None] * 1e-6
    _, fixes = play(Replay(recording(3, t=[1.0, 1.5, 4.0], cov=cov), speed=0))
    assert [fix.t for fix in fixes] == [1.0, 1.5, 4.0]
    assert [fix.cov.tolist() for fix in fixes] == cov.tolist()


def test_pixel_centres_are_played() -> None:
    _, fixes = play(Replay(recording(1, centres_px=[[1, 2, 3, 4]]), speed=0))
    assert fixes[0].centres_px == (1, 2, 3, 4)


def test_orientations_are_played() -> None:
    _, fixes = play(Replay(recording(1, orientation=[[0.0, 0.6, 0.0, 0.8]]), speed=0))
    assert fixes[0].R is not None
    assert fixes[0].R.tolist() == [0.0, 0.6, 0.0, 0.8]


def test_times_are_made_up_for_rows_without() -> None:
    assert np.allclose(np.diff(Replay(recording(30)).t), 1 / 30)


def test_times_go_on_where_the_clock_was_reset() -> None:
    t = Replay(recording(4, t=[5.0, 6.0, 1.0, 3.0], segment=[1, 1, 2, 2])).t
    assert np.diff(t).tolist() == [1.0, RecordingSettings.reset_gap_s, 2.0]


def test_both_sides_report_the_end() -> None:
    replay = Replay(recording(3), speed=0)
    with replay.joints as joints, replay.marker as marker:
        for source in (joints, marker):
            assert len(drain_to_end(source)) == 3
            with pytest.raises(SourceEnded):
                source.read(0.0)


def drain_to_end(source: JointSource | MarkerSource) -> list[object]:
    taken = []
    while True:
        try:
            taken.append(source.read(0.0))
        except SourceEnded:
            return taken


@pytest.mark.parametrize("leader", ["joints", "marker"])
def test_neither_side_runs_away_from_the_other(leader: str) -> None:
    replay = Replay(recording(100), speed=0)
    with replay.joints as joints, replay.marker as marker:
        first, second = (joints, marker) if leader == "joints" else (marker, joints)
        assert len(drain(first)) == ReplaySettings.rows_ahead
        second.read(0.0)
        assert len(drain(first)) == 1


def test_two_threads_play_it_through() -> None:
    played = recording(500)
    replay = Replay(played, speed=0)
    readings: list[JointReading] = []

    def read_joints() -> None:
        with replay.joints as joints:
            while len(readings) < len(played):
                reading = joints.read(300.0)
                assert reading is not None
                readings.append(reading)

    thread = threading.Thread(target=read_joints)
    thread.start()
    with replay.marker as marker:
        fixes = [marker.read(300.0) for _ in range(len(played))]
    thread.join()
    assert [fix.t for fix in fixes if fix is not None] == [reading.t for reading in readings]


@pytest.mark.parametrize(("speed", "seconds"), [(1.0, 2.0), (4.0, 0.5)])
def test_row_is_played_at_its_time(speed: float, seconds: float) -> None:
    clock = Hand()
    replay = Replay(recording(2, t=[10.0, 12.0]), speed=speed, now=clock)
    with replay.marker as marker:
        assert marker.read(0.0) is not None
        clock.time += seconds * 0.99
        assert marker.read(0.0) is None
        clock.time += seconds * 0.02
        assert marker.read(0.0) is not None


def test_at_speed_nought_no_clock_is_asked() -> None:
    def never() -> float:
        raise AssertionError

    readings, _ = play(Replay(recording(3, t=[0.0, 1e3, 1e6]), speed=0, now=never))
    assert len(readings) == 3


@pytest.mark.parametrize("source", [lambda replay: replay.joints, lambda replay: replay.marker])
def test_a_source_that_is_not_open_refuses(source: Callable[[Replay], JointSource | MarkerSource]) -> None:
    with pytest.raises(SourceError, match="with"):
        source(Replay(recording())).read(0.0)


def test_default_noise_is_one_millimetre() -> None:
    _, fixes = play(Replay(recording(1), speed=0))
    assert np.allclose(fixes[0].cov, np.eye(3) * 1e-6, rtol=1e-12, atol=0)


def test_a_sigma_that_is_given_is_taken() -> None:
    _, fixes = play(Replay(recording(1), speed=0, sigma_m=0.01, calibration=STEREO))
    assert np.allclose(fixes[0].cov, np.eye(3) * 1e-4, rtol=1e-12, atol=0)


def test_without_covariances_a_stereo_cameras_pixel_noise_decides() -> None:
    depth = 1.5
    played = Recording(("a",), np.zeros((1, 1)), np.array([[0.0, 0.0, depth]]))
    _, fixes = play(Replay(played, speed=0, calibration=STEREO))
    pixel = STEREO.pixel_sigma * depth / STEREO.focal_px
    along = np.sqrt(2) * pixel * depth / STEREO.baseline_m  # the disparity is the difference of two columns
    assert np.allclose(np.sqrt(np.diag(fixes[0].cov)), [pixel, pixel / np.sqrt(2), along], rtol=1e-9)


def test_points_behind_the_camera_take_no_pixel_noise() -> None:
    played = Recording(("a",), np.zeros((1, 1)), np.array([[0.0, 0.0, -1.0]]))
    _, fixes = play(Replay(played, speed=0, calibration=STEREO))
    assert np.allclose(fixes[0].cov, np.eye(3) * 1e-6, rtol=1e-12, atol=0)
