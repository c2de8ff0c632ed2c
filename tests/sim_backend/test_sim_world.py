from __future__ import annotations

import subprocess
import threading
from dataclasses import replace
from datetime import datetime

import numpy as np
import pytest
from guided_run import NoRenderer, shipped
from test_sim_rendering import red_pixels

from bodyschema.interfaces.errors import SourceEnded, SourceLost
from bodyschema.interfaces.protocols import JointSource, StereoCamera
from bodyschema.sim_backend import SimConfig, SimWorld, ToolChange

WAIT_S = 300.0


@pytest.fixture
def world():
    """Yield an open world with both sources open."""
    with SimWorld(shipped(), SimConfig(seed=2)) as world, world.joints, world.camera:
        yield world


@pytest.fixture
def unrendered(monkeypatch):
    """Open worlds without a renderer: their images are black."""
    monkeypatch.setattr("bodyschema.sim_backend.world.RenderProcess", NoRenderer)


@pytest.fixture
def black(unrendered):
    """Yield an open world with both sources open that renders nothing."""
    with SimWorld(shipped(), SimConfig(seed=2)) as world, world.joints, world.camera:
        yield world


@pytest.fixture(scope="module")
def running():
    """Yield an open world that tests share; its time goes on from test to test."""
    with SimWorld(shipped(), SimConfig(seed=2)) as world, world.joints, world.camera:
        world.begun = begin(world)
        yield world


def begin(world):
    """Return the first frames, and the readings until the last of them."""
    taken = frames(world, 2)
    return readings_until(world, taken[-1].t), taken


def frames(world, count):
    return [world.camera.read(WAIT_S) for _ in range(count)]


def readings_until(world, t):
    readings = []
    while not readings or readings[-1].t < t:
        readings.append(world.joints.read(WAIT_S))
    return readings


def red_centre(image):
    blue, green, red = np.moveaxis(image.astype(int), -1, 0)
    rows, columns = np.nonzero((red > 90) & (red > 2 * green) & (red > 2 * blue))
    return np.array([columns.mean(), rows.mean()])


def triangulated(calibration, frame):
    left, right = red_centre(frame.left), red_centre(frame.right)
    z = calibration.focal_px * calibration.baseline_m / (left[0] - right[0])
    return np.append((left - calibration.principal_point_px) * z / calibration.focal_px, z)


def test_sources_implement_the_sampler_s_interface(running):
    assert isinstance(running.joints, JointSource)
    assert isinstance(running.camera, StereoCamera)


def test_same_seed_gives_bitwise_identical_readings_and_frames(running, world):
    runs = running.begun, begin(world)
    for first, second in zip(runs[0][0], runs[1][0], strict=True):
        assert first.t == second.t
        np.testing.assert_array_equal(first.q, second.q)
    for first, second in zip(runs[0][1], runs[1][1], strict=True):
        assert first.t == second.t
        np.testing.assert_array_equal(first.left, second.left)
        np.testing.assert_array_equal(first.right, second.right)


def test_two_threads_get_ordered_readings_and_frames(black):
    times, seen = [], []

    def read_joints():
        while not times or times[-1] < 0.4:
            reading = black.joints.read(WAIT_S)
            times.append(reading.t)

    reader = threading.Thread(target=read_joints)
    reader.start()
    while not seen or seen[-1] < 0.4:
        seen.append(black.camera.read(WAIT_S).t)
    reader.join(WAIT_S)
    np.testing.assert_allclose(times, np.arange(1, 49) / 120, atol=1e-12)
    np.testing.assert_allclose(seen, np.arange(1, 13) / 30, atol=1e-12)


def test_encoders_lead_camera_by_at_most_two_frames(black):
    times = []
    while (reading := black.joints.read(0.0)) is not None:
        times.append(reading.t)
    assert times[-1] == pytest.approx(2 / 30)


def test_camera_waits_for_unread_joints(black):
    frame = black.camera.read(WAIT_S)
    while frame is not None:
        last = frame.t
        frame = black.camera.read(0.0)
    assert last == pytest.approx(1.0)


def test_joints_run_on_without_an_open_camera(unrendered):
    with SimWorld(shipped(), SimConfig()) as world, world.joints:
        assert readings_until(world, 0.5)[-1].t == pytest.approx(0.5)


def test_triangulated_ball_matches_the_true_chain(running):
    misses = []
    for frame in frames(running, 10):
        reading = readings_until(running, frame.t)[-1]
        assert reading.t == pytest.approx(frame.t)
        misses.append(triangulated(running.camera.calibration, frame) - running.true_chain().positions(reading.q))
    # A crude threshold centroid: a third of a pixel, and 2 mm of encoder ticks and noise; depth is the worst.
    assert np.abs(misses)[:, :2].max() < 2e-3
    assert np.abs(misses)[:, 2].max() < 10e-3


def test_tool_change_shows_in_frames_and_truth(running):
    world = running
    frame = frames(world, 3)[-1]
    q = readings_until(world, frame.t)[-1].q
    before = world.true_chain().positions(q)
    changed_at = world.change_tool((0.23, 0.0, -0.37))
    assert np.linalg.norm(world.true_chain().positions(q) - before) == pytest.approx(0.25, abs=1e-9)
    while (frame := world.camera.read(WAIT_S)).t <= changed_at:
        continue
    q = readings_until(world, frame.t)[-1].q
    miss = triangulated(world.camera.calibration, frame) - world.true_chain().positions(q)
    assert np.linalg.norm(miss) < 15e-3


def test_a_planned_tool_change_happens_at_its_time(unrendered):
    change = ToolChange(at_s=0.1, marker_xyz=(0.23, 0.0, -0.37))
    with SimWorld(shipped(), SimConfig(tool_changes=(change,))) as world, world.joints:
        readings_until(world, 0.09)
        before = world.stats.tool_changes
        readings_until(world, 0.11)
        assert (before, world.stats.tool_changes) == (0, 1)


def test_the_clock_shows_simulated_time(unrendered):
    with SimWorld(shipped(), SimConfig()) as world, world.joints:
        opened = datetime.fromisoformat(world.clock.utc())
        readings_until(world, 0.05)
        assert world.clock.now() == pytest.approx(0.05)
        assert (datetime.fromisoformat(world.clock.utc()) - opened).total_seconds() == pytest.approx(0.05, abs=2e-3)


def test_frames_cannot_be_changed_by_their_readers(running):
    frame = running.camera.read(WAIT_S)
    readings_until(running, frame.t)
    with pytest.raises(ValueError, match="read-only"):
        frame.left[0, 0, 0] = 1


def test_a_closed_world_has_no_more_readings(unrendered):
    with SimWorld(shipped(), SimConfig()) as world, world.joints as joints:
        joints.read(WAIT_S)
    with pytest.raises(SourceEnded):
        joints.read(WAIT_S)


def test_closing_world_wakes_a_waiting_reader(unrendered):
    told = threading.Event()
    with SimWorld(shipped(), SimConfig()) as world, world.joints, world.camera:
        while world.joints.read(0.0) is not None:
            continue

        def wait():
            with pytest.raises(SourceEnded):
                world.joints.read(WAIT_S)
            told.set()

        reader = threading.Thread(target=wait)
        reader.start()
    assert told.wait(WAIT_S)
    reader.join(WAIT_S)


def test_dead_renderer_is_lost_until_camera_reopens(running):
    world = running
    world._renderer.process.kill()
    with pytest.raises(SourceLost, match="renderer"):
        frames(world, 10)
    with world.camera:
        assert None not in frames(world, 3)


def test_lost_renderer_is_reported_with_its_exit_code(monkeypatch):
    start = "bodyschema.sim_backend.rendering.render_client._start"
    monkeypatch.setattr(start, lambda *_: subprocess.Popen(["sh", "-c", "sleep 0.2; exit 3"]))
    with pytest.raises(SourceLost, match="exit code 3"), SimWorld(shipped(), SimConfig(seed=3)):
        pass


def test_one_eyed_robot_renders_one_image_with_marker():
    robot = shipped()
    assert robot.calibration is not None
    alone = replace(robot, calibration=replace(robot.calibration, baseline_m=0.0))
    with SimWorld(alone, SimConfig(seed=3)) as world, world.joints, world.camera:
        frame = world.next_frame(WAIT_S)
    assert frame is not None
    assert frame.right is None
    assert red_pixels(frame.left) > 50
