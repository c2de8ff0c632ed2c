"""The two infra-red eyes of a RealSense camera, through the vendor's SDK (the extra `realsense`).

The device rectifies its infra-red images itself, and provides their calibration. Its depth image is kept as a check.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from types import TracebackType
from typing import Any, Self

import numpy as np

from bodyschema.interfaces.camera import StereoCalibration
from bodyschema.interfaces.errors import ConfigError, SourceError, SourceLost
from bodyschema.interfaces.protocols import Clock
from bodyschema.interfaces.records import ImageArray, StereoFrame
from bodyschema.interfaces.waits import Waits

from .config import CamerasConfig, RealsenseConfig
from .stamps import Stamps


class _Settings:
    queued_images = 16  # in the SDK's queue: five frames of three images
    max_skew = 1e-3  # of rectified images: different focal lengths or turned eyes, relative or [rad]
    window_px = 3  # around the marker's centre, in the depth image


FindDevice = Callable[[str | None], Any]


def sdk() -> Any:
    """Return the module pyrealsense2; raise ModuleNotFoundError if the extra `realsense` is not installed."""
    import pyrealsense2  # pyright: ignore[reportMissingImports]: an extra

    return pyrealsense2


def connected_device(serial: str | None) -> Any:
    """Return the connected RealSense with this serial number, or the only one.

    Raises:
        SourceLost: it is not connected.
        ConfigError: several are connected, and `serial` is not set.
    """
    rs = sdk()
    devices = {device.get_info(rs.camera_info.serial_number): device for device in rs.context().query_devices()}
    if serial is None and len(devices) > 1:
        raise ConfigError(
            f"several RealSense cameras are connected: {', '.join(devices)}",
            remedy="Name one as serial in [vision.cameras.realsense]",
        )
    if not devices or (serial is not None and serial not in devices):
        there = f"connected are {', '.join(devices)}" if devices else "none is connected"
        requested = "RealSense camera" if serial is None else f"RealSense camera {serial}"
        raise SourceLost(
            f"the {requested} is not there; {there}. Plug it into a USB 3 port, and see what `lsusb -d 8086:` lists",
            brief=f"the {requested} is not there",
        )
    return next(iter(devices.values())) if serial is None else devices[serial]


class RealsenseCamera:
    """`StereoEyes` and `StereoCamera` of the infra-red eyes of one device.

    Attributes:
        depth_image_m: the depth image of the newest frame [m], 0 where unknown; None without one.
    """

    def __init__(
        self,
        config: CamerasConfig,
        settings: RealsenseConfig,
        clock: Clock,  # the machine's monotonic one
        find: FindDevice = connected_device,  # returns the device with a serial number
    ) -> None:
        """Store the settings. The device is searched for when it is opened, or when its calibration is requested."""
        self._config, self._settings, self._clock, self._find = config, settings, clock, find
        self._calibration: StereoCalibration | None = None
        self._serial = settings.serial or ""
        self._sensor: Any = None
        self._queue: Any = None
        self._stamps = Stamps()
        self._parts: dict[int, dict[str, Any]] = {}
        self._heard = -math.inf
        self.depth_image_m: np.ndarray | None = None

    @property
    def image_size_px(self) -> tuple[int, int]:
        """Width and height of each eye's image."""
        return self._settings.image_size_px

    @property
    def serials(self) -> tuple[str, ...]:
        """Identifiers of the eyes."""
        return f"{self._serial}/left", f"{self._serial}/right"

    @property
    def health(self) -> tuple[str, ...]:
        """Problems of the camera, each with its remedy."""
        if self._stamps.source == "arrival":
            return (
                "the RealSense gives no time stamps on this machine's clock: images are dated when they arrive, to "
                f"{1e3 * self._stamps.sigma_s:.0f} ms. Update its firmware: `rs-fw-update`",
            )
        return ()

    @property
    def calibration(self) -> StereoCalibration:
        """Calibration of the eyes, as reported by the device.

        Raises:
            SourceLost: the device is not connected.
            SourceError: it does not rectify these images.
        """
        if self._calibration is None:
            _, profiles = self._profiles(self._find(self._settings.serial))
            self._calibration = self._seen_by(profiles["left"], profiles["right"])
        return self._calibration

    def __enter__(self) -> Self:
        rs = sdk()
        device = self._find(self._settings.serial)
        self._serial = device.get_info(rs.camera_info.serial_number)
        sensor, profiles = self._profiles(device)
        self._calibration = self._seen_by(profiles["left"], profiles["right"])
        self._apply(rs, sensor)
        self._queue = rs.frame_queue(_Settings.queued_images, True)
        self._stamps, self._parts, self.depth_image_m = Stamps(), {}, None
        try:
            sensor.open(list(profiles.values()))
            self._sensor = sensor
            sensor.start(self._queue)
        except RuntimeError as error:
            self._close()
            raise SourceLost(
                f"the RealSense {self._serial} cannot be started: {error}. Is another program using it, or is it on a "
                "USB 2 port?",
                brief=f"the RealSense {self._serial} cannot be started",
            ) from error
        self._heard = self._clock.now()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._close()

    def read(self, timeout_s: float) -> StereoFrame | None:
        """Return the next pair of images; None if none came within `timeout_s`.

        Raises:
            SourceLost: the device went away.
        """
        if self._sensor is None:
            raise SourceError("the RealSense is not open")
        deadline = self._clock.now() + timeout_s
        while True:
            left_ms = max(1, round(1e3 * (deadline - self._clock.now())))
            is_there, image = self._queue.try_wait_for_frame(left_ms)
            now = self._clock.now()
            if is_there:
                self._heard = now
                frame = self._whole(image, now)
                if frame is not None:
                    return frame
            elif now - self._heard > Waits.silent_after_s:
                raise SourceLost(
                    f"the RealSense {self._serial} sends no images. Is it plugged in?",
                    brief=f"the RealSense {self._serial} sends no images",
                )
            if now >= deadline:
                return None

    def depth_m(self, u: float, v: float) -> float | None:
        """Return the depth at a pixel of the left image [m], the median around it; None if it is unknown."""
        if self.depth_image_m is None:
            return None
        row, column = round(v), round(u)
        window = self.depth_image_m[
            max(row - _Settings.window_px, 0) : row + _Settings.window_px + 1,
            max(column - _Settings.window_px, 0) : column + _Settings.window_px + 1,
        ]
        known = window[window > 0]
        return float(np.median(known)) if known.size else None

    def _close(self) -> None:
        if self._sensor is not None:
            try:
                self._sensor.stop()
                self._sensor.close()
            except RuntimeError:  # it was unplugged
                pass
            self._sensor = None

    def _profiles(self, device: Any) -> tuple[Any, dict[str, Any]]:
        """Return the stereo sensor, and the streams to open: left, right, and depth if it is wanted.

        Raises:
            SourceError: the device has no such streams.
        """
        rs = sdk()
        width, height = self._settings.image_size_px
        offered: set[str] = set()
        for sensor in device.query_sensors():
            found: dict[str, Any] = {}
            for profile in sensor.get_stream_profiles():
                if not profile.is_video_stream_profile():
                    continue
                video = profile.as_video_stream_profile()
                name = _stream_name(rs, profile)
                if name == "left":
                    offered.add(f"{video.width()}x{video.height()} at {profile.fps()}")
                if (video.width(), video.height(), profile.fps()) == (width, height, round(self._settings.fps)):
                    found[name] = profile
            if {"left", "right"} <= found.keys():
                requested = ("left", "right", *(["depth"] if self._settings.depth_check and "depth" in found else []))
                return sensor, {name: found[name] for name in requested}
        raise SourceError(
            f"the RealSense has no pair of infra-red images of {width}x{height} pixels at {self._settings.fps:g} a "
            f"second. Choose among {', '.join(sorted(offered)) or 'none'} in [vision.cameras.realsense]"
        )

    def _seen_by(self, left: Any, right: Any) -> StereoCalibration:
        """Return the calibration of a rectified pair; raise SourceError if the device does not rectify it."""
        eyes = [profile.as_video_stream_profile().get_intrinsics() for profile in (left, right)]
        pose = left.get_extrinsics_to(right)
        focal = eyes[0].fx
        unlike = [abs(eye.fx / focal - 1) + abs(eye.fy / focal - 1) for eye in eyes]
        distortion = max(abs(value) for eye in eyes for value in eye.coeffs)
        turn = float(np.abs(np.reshape(pose.rotation, (3, 3)) - np.eye(3)).max())
        baseline_m = -pose.translation[0]
        if max(*unlike, distortion, turn) > _Settings.max_skew or baseline_m <= 0:
            raise SourceError(
                "the RealSense does not rectify these images: calibrate the eyes like two cameras (`bodyschema "
                "calibrate cameras`), and name the file as calibration in [vision.cameras]"
            )
        return StereoCalibration(focal, (eyes[0].ppx, eyes[0].ppy), baseline_m, self.image_size_px)

    def _apply(self, rs: Any, sensor: Any) -> None:
        """Write the settings. The projector is off by default: its dots would be taken for texture of the marker."""
        requested: dict[Any, float] = {rs.option.emitter_enabled: float(self._settings.emitter)}
        requested[rs.option.global_time_enabled] = 1.0
        if self._settings.exposure_s is not None:
            requested |= {rs.option.enable_auto_exposure: 0.0, rs.option.exposure: 1e6 * self._settings.exposure_s}
        if self._settings.gain is not None:
            requested[rs.option.gain] = self._settings.gain
        for option, value in requested.items():
            if sensor.supports(option) and not sensor.is_option_read_only(option):
                sensor.set_option(option, value)

    def _whole(self, image: Any, now: float) -> StereoFrame | None:
        """Return the frame that an image completes; its images have the same number."""
        rs = sdk()
        number, name = image.get_frame_number(), _stream_name(rs, image.get_profile())
        part = self._parts.setdefault(number, {})
        part[name] = image
        if not {"left", "right"} <= part.keys() or (self._settings.depth_check and "depth" not in part):
            self._parts = {key: value for key, value in self._parts.items() if key > number - _Settings.queued_images}
            return None
        self._parts = {key: value for key, value in self._parts.items() if key > number}
        t = self._stamps.stamp(self._on_our_clock(rs, part["left"], now), now)
        if t is None:
            return None
        if "depth" in part:
            depth = part["depth"].as_depth_frame()
            self.depth_image_m = np.asanyarray(depth.get_data()) * depth.get_units()
        sigma = math.hypot(self._stamps.sigma_s, self._config.sigma_s)
        return StereoFrame(t - self._config.latency_s, _coloured(part["left"]), _coloured(part["right"]), sigma)

    def _on_our_clock(self, rs: Any, image: Any, now: float) -> float:
        """Return an image's timestamp on the monotonic clock [s]; 0 if it is on a clock of the device's own."""
        if image.get_frame_timestamp_domain() == rs.timestamp_domain.hardware_clock:
            return 0.0
        return now - (time.time() - 1e-3 * image.get_timestamp())


def _stream_name(rs: Any, profile: Any) -> str:
    """Return left, right or depth, or the SDK's name of another stream."""
    kind, index = profile.stream_type(), profile.stream_index()
    if kind == rs.stream.infrared and profile.format() == rs.format.y8:
        return {1: "left", 2: "right"}.get(index, "infrared")
    return "depth" if kind == rs.stream.depth else str(profile.stream_name())


def _coloured(image: Any) -> ImageArray:
    """Return a grey image of the SDK with three equal channels, copied out of its queue."""
    grey: Sequence[Any] = np.asanyarray(image.get_data())
    return np.repeat(np.asarray(grey, dtype=np.uint8)[:, :, None], 3, axis=2)
