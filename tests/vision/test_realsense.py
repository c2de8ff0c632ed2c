"""A RealSense camera: the adapter on the SDK's own software device, and the check by depth."""

from __future__ import annotations

import sys
import time
from importlib.util import find_spec
from typing import Any

import cv2
import numpy as np
import pytest

from bodyschema.interfaces.clock import SystemClock
from bodyschema.interfaces.errors import SourceError, SourceLost
from bodyschema.interfaces.extras import install_command
from bodyschema.interfaces.records import MarkerFix, frozen_array
from bodyschema.vision.cameras.config import CamerasConfig, RealsenseConfig
from bodyschema.vision.cameras.depth_check import DepthChecked
from bodyschema.vision.cameras.realsense import RealsenseCamera, connected_device
from bodyschema.vision.config import VisionConfig
from bodyschema.vision.tracked_camera import TrackedCamera
from bodyschema.vision.trackers import tracker_of

SDK = pytest.mark.skipif(
    find_spec("pyrealsense2") is None, reason="no pyrealsense2; to run it: pip install pyrealsense2"
)
WIDTH, HEIGHT, FOCAL_PX, BASELINE_M = 320, 240, 200.0, 0.05
CENTRE_PX = (159.5, 119.5)
SETTINGS = RealsenseConfig(image_size_px=(WIDTH, HEIGHT))
BALL, RADIUS_M = (0.03, -0.02, 0.4), 0.02
LIMIT_S = 300.0


class Device:
    """A software device of the SDK with the streams of a D435."""

    def __init__(self, *, distortion: float = 0.0) -> None:
        import pyrealsense2 as rs  # pyright: ignore[reportMissingImports]: an extra

        self.rs, self.number = rs, 0
        self.device = rs.software_device()
        self.device.register_info(rs.camera_info.serial_number, "123456")
        self.sensor = self.device.add_sensor("Stereo Module")
        eye, depth = (rs.stream.infrared, rs.format.y8, 1), (rs.stream.depth, rs.format.z16, 2)
        self.streams = [self._stream(*kind, place, distortion) for place, kind in enumerate((depth, eye, eye))]
        self.sensor.add_read_only_option(rs.option.depth_units, 0.001)
        apart = rs.extrinsics()
        apart.rotation, apart.translation = [1, 0, 0, 0, 1, 0, 0, 0, 1], [-BASELINE_M, 0, 0]
        self.streams[1].register_extrinsics_to(self.streams[2], apart)

    def _stream(self, kind: Any, form: Any, size: int, index: int, distortion: float) -> Any:
        rs, stream = self.rs, self.rs.video_stream()
        eye = rs.intrinsics()
        eye.width, eye.height, eye.fx, eye.fy, eye.ppx, eye.ppy = WIDTH, HEIGHT, FOCAL_PX, FOCAL_PX, *CENTRE_PX
        eye.model, eye.coeffs = rs.distortion.brown_conrady, [distortion, 0, 0, 0, 0]
        stream.type, stream.index, stream.uid, stream.fmt, stream.bpp = kind, index, index, form, size
        stream.width, stream.height, stream.fps, stream.intrinsics = WIDTH, HEIGHT, 30, eye
        return self.sensor.add_video_stream(stream)

    def show(self, depth_mm: Any, left: Any, right: Any, *, domain: str = "global_time") -> None:
        """Send one image of each stream, taken 20 ms ago."""
        self.number += 1
        for stream, value, kind in zip(
            self.streams, (depth_mm, left, right), (np.uint16, *[np.uint8] * 2), strict=True
        ):
            image = self.rs.software_video_frame()
            image.pixels = np.array(np.broadcast_to(value, (HEIGHT, WIDTH)), kind)
            image.bpp = np.dtype(kind).itemsize
            image.stride, image.frame_number = WIDTH * image.bpp, self.number
            image.timestamp, image.domain = 1e3 * (time.time() - 0.02), getattr(self.rs.timestamp_domain, domain)
            image.profile, image.depth_units = stream.as_video_stream_profile(), 0.001
            self.sensor.on_video_frame(image)

    def camera(self, settings: RealsenseConfig = SETTINGS) -> RealsenseCamera:
        config = CamerasConfig(realsense=settings, latency_sigma_s=0.0)
        return RealsenseCamera(config, settings, SystemClock(), find=lambda _: self.device)


@pytest.fixture
def device() -> Device:
    return Device()


def shown(device: Device, source: Any, images: tuple[Any, Any, Any] = (850, 10, 200), **keys) -> Any:
    """Return the first frame or fix; the first images only settle how they are dated."""
    end = time.monotonic() + LIMIT_S
    while time.monotonic() < end:
        device.show(*images, **keys)
        frame = source.read(0.05)
        if frame is not None:
            return frame
    raise AssertionError("no frame")


def ball_seen_from(eye_m: float) -> np.ndarray:
    """Return the grey image of a bright ball in an eye that stands at (eye_m, 0, 0)."""
    x, y, z = BALL
    image = np.full((HEIGHT, WIDTH), 20, np.uint8)
    at = [round(16 * (c + FOCAL_PX * v / z)) for c, v in zip(CENTRE_PX, (x - eye_m, y), strict=True)]
    cv2.circle(image, (at[0], at[1]), round(16 * FOCAL_PX * RADIUS_M / z), 240, -1, cv2.LINE_AA, 4)
    return cv2.GaussianBlur(image, (0, 0), 0.7)


@SDK
def test_intrinsics_come_from_the_device(device) -> None:
    found = device.camera().calibration
    assert (found.focal_px, found.principal_point_px) == (FOCAL_PX, CENTRE_PX)
    assert found.baseline_m == pytest.approx(BASELINE_M)


@SDK
def test_both_eyes_and_depth_are_of_one_frame(device) -> None:
    with device.camera() as camera:
        frame = shown(device, camera)
        assert camera.depth_m(30.0, 20.0) == pytest.approx(0.85)
    assert frame.right is not None
    assert (frame.left.shape, frame.left[0, 0].tolist(), frame.right[0, 0].tolist()) == (
        (HEIGHT, WIDTH, 3),
        [10, 10, 10],
        [200, 200, 200],
    )
    assert time.monotonic() - LIMIT_S < frame.t < time.monotonic() - 0.015
    assert frame.t_sigma < 0.002


@SDK
@pytest.mark.parametrize(("depth_mm", "complaints"), [(380, 0), (500, 1)])
def test_bright_ball_is_measured_and_checked_by_depth(device, depth_mm, complaints) -> None:
    images = (depth_mm, ball_seen_from(0.0), ball_seen_from(BASELINE_M))
    camera = device.camera()
    vision = VisionConfig(marker="bright_ball", radius_m=RADIUS_M)
    tracked = TrackedCamera(camera, tracker_of(camera.calibration, vision))
    with DepthChecked(tracked, camera, RADIUS_M) as checked:
        for _ in range(25):
            fix = shown(device, checked, images)
    assert isinstance(fix, MarkerFix)
    assert fix.x == pytest.approx(BALL, abs=0.006)
    assert len(checked.health) == complaints


@SDK
def test_hardware_clock_timestamps_are_not_used(device) -> None:
    with device.camera() as camera:
        assert shown(device, camera, domain="hardware_clock").t_sigma > 0.01
        assert "Update its firmware" in camera.health[0]


@SDK
def test_unrectified_images_need_a_calibration() -> None:
    with pytest.raises(SourceError, match="does not rectify these images: calibrate"):
        _ = Device(distortion=0.05).camera().calibration


@SDK
def test_missing_size_is_named_with_those_there(device) -> None:
    with pytest.raises(SourceError, match=r"no pair of infra-red images of 848x480 .* Choose among 320x240 at 30"):
        device.camera(RealsenseConfig()).__enter__()


@SDK
def test_silent_device_is_lost(device, monkeypatch) -> None:
    monkeypatch.setattr("bodyschema.interfaces.waits.Waits.silent_after_s", 0.1)
    with device.camera() as camera, pytest.raises(SourceLost, match="sends no images"):
        camera.read(0.3)


@SDK
def test_absent_device_is_named() -> None:
    with pytest.raises(SourceLost, match="the RealSense camera 42 is not there; none is connected"):
        connected_device("42")


def test_missing_sdk_is_a_missing_extra(monkeypatch) -> None:
    from bodyschema.interfaces.extras import missing_module

    monkeypatch.setitem(sys.modules, "pyrealsense2", None)
    with pytest.raises(ModuleNotFoundError) as error:
        connected_device(None)
    told = missing_module(error.value)
    assert told is not None
    assert told.remedy == f"Type: {install_command('realsense')}"


class Fixed:
    """A `MarkerSource` at 0.8 m, and a depth image that says something else in every n-th frame."""

    def __init__(self, depth_m: float, every: int) -> None:
        self._depth_m, self._every, self._frames = depth_m, every, 0

    def __enter__(self) -> Fixed:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def read(self, timeout_s: float) -> MarkerFix:
        return MarkerFix(
            0.0, frozen_array([0, 0, 0.8]), frozen_array(1e-6 * np.eye(3)), centres_px=(1.0, 2.0, 0.5, 2.0)
        )

    def depth_m(self, u: float, v: float) -> float:
        self._frames += 1
        return 0.78 if self._frames % self._every else self._depth_m


@pytest.mark.parametrize(("depth_m", "every", "complaints"), [(0.78, 1, 0), (0.95, 1, 1), (0.95, 3, 1), (0.95, 9, 0)])
def test_depth_that_contradicts_in_many_frames_is_reported(depth_m, every, complaints) -> None:
    scene = Fixed(depth_m, every)
    with DepthChecked(scene, scene, in_front_m=0.02) as checked:
        for _ in range(50):
            checked.read(0.1)
    assert len(checked.health) == complaints
    assert all(
        "the depth image has the marker at 0.970 m where the two eyes measure 0.800 m" in said
        for said in checked.health
    )
