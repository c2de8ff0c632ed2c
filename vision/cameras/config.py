"""The table [vision.cameras] of robot.toml."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Annotated, Literal

import msgspec
import numpy as np
from msgspec import Meta

from bodyschema.interfaces.camera import LARGEST_SIDE_PX
from bodyschema.interfaces.errors import ConfigError
from bodyschema.interfaces.records import FloatArray
from bodyschema.robot.rpy import rotation_of
from bodyschema.robot.toml_file import NonNegative, Positive, line_of

Side = Annotated[int, Meta(ge=16, le=LARGEST_SIDE_PX)]

LAYOUTS = ("one", "two", "side_by_side", "realsense", "images", "videos")
# Latency uncertainty of an uncalibrated camera [s]: exposure, readout and transfer of a webcam.
UNKNOWN_LATENCY_SIGMA_S = 0.015
ENUMERATED = re.compile(r"\d+|/dev/video\d+")


class DeviceConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Keys of all cameras that are plugged in."""

    image_size_px: tuple[Side, Side]  # width and height of each eye's image
    fps: Positive = 30.0  # frames per second
    exposure_s: Positive | None = None  # exposure time; without it the camera chooses, and the ball's brightness drifts
    # in the camera's units, as `v4l2-ctl -l` shows them where it is a webcam; without it unchanged
    gain: NonNegative | None = None


class UvcSettings(DeviceConfig, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Settings written to a webcam when it is opened, and read back afterwards."""

    fourcc: Literal["MJPG", "YUYV"] = "MJPG"  # transfer format: MJPG (compressed) or YUYV (about five times as much)
    # kernel buffers. A camera that loses every second frame with 1 needs 2.
    buffers: Annotated[int, Meta(ge=1, le=10)] = 1
    white_balance_k: Positive | None = None  # colour temperature [K]; without it the camera chooses
    # in the camera's units; without it unchanged. A lens that refocuses changes the calibration.
    focus: NonNegative | None = None


class OneConfig(UvcSettings, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The table [vision.cameras.one]: a single camera."""

    device: str  # its name in /dev/v4l/by-id or by-path


class TwoConfig(UvcSettings, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The table [vision.cameras.two]: one free-running camera for each eye."""

    # left, right: the devices, by their names in /dev/v4l/by-id or by-path
    left: str
    right: str

    @property
    def max_gap_s(self) -> float:
        """Longest time between the two images of a pair: free-running cameras are up to half a frame apart."""
        return 0.6 / self.fps


class SideBySideConfig(UvcSettings, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The table [vision.cameras.side_by_side]: one camera with both eyes in its image, the left one on the left."""

    device: str  # its name in /dev/v4l/by-id or by-path


class RealsenseConfig(DeviceConfig, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The table [vision.cameras.realsense]: the infra-red eyes of a RealSense camera, by the extra `realsense`."""

    serial: str | None = None  # its serial number; needed where several are connected
    image_size_px: tuple[Side, Side] = (848, 480)  # width and height of each eye's image
    emitter: bool = False  # keep the projector on. Its dots disturb the tracker.
    depth_check: bool = True  # compare the marker's depth with the depth image


class FilesConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Keys of recorded images."""

    times: str | None = None  # a text file with the time of each frame [s], one a line
    # in its place: the rate [1/s]; videos take that in the file without either
    fps: Positive | None = None
    speed: NonNegative = 1.0  # 1 as recorded, 2 twice as fast, 0 as fast as they are read


class ImagesConfig(FilesConfig, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The table [vision.cameras.images]: image files instead of cameras, sorted by name."""

    # left, right: patterns relative to robot.toml, such as "left/*.png"; only `left` for a single camera
    left: str
    right: str | None = None
    # in the place of times: the last number in each name is its time, in ticks of this rate (1e9: nanoseconds)
    name_ticks_per_s: Positive | None = None


class VideosConfig(FilesConfig, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The table [vision.cameras.videos]: video files instead of cameras."""

    # left, right: a file for each eye, relative to robot.toml; only `left` for a single camera
    left: str | None = None
    right: str | None = None
    side_by_side: str | None = None  # in their place: one file with both eyes' images in each frame, left and right


class CamerasConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The table [vision.cameras]: source of the images. Exactly one of the six layouts is given."""

    # the file that `bodyschema calibrate cameras` wrote, relative to robot.toml. Without it the images are assumed to
    # be rectified, as [camera] describes.
    calibration: str | None = None
    # time from mid-exposure to the timestamp [s]; `bodyschema calibrate latency` measures it
    latency_s: Annotated[float, Meta(ge=-1, le=1)] = 0.0
    latency_sigma_s: NonNegative | None = None  # its 1-sigma; without it 15 ms for devices, 0 for files
    # time from the exposure of a rolling shutter's first row to that of its last [s]; 0 for a global shutter. Without
    # it, it may be anything up to the time of a frame, and a moving marker's position has a larger sigma.
    readout_s: Annotated[float, Meta(ge=0, le=0.1)] | None = None
    one: OneConfig | None = None
    two: TwoConfig | None = None
    side_by_side: SideBySideConfig | None = None
    realsense: RealsenseConfig | None = None
    images: ImagesConfig | None = None
    videos: VideosConfig | None = None

    @property
    def layout(self) -> OneConfig | TwoConfig | SideBySideConfig | RealsenseConfig | ImagesConfig | VideosConfig:
        """The configured layout; call `check` first."""
        found = self.one or self.two or self.side_by_side or self.realsense or self.images or self.videos
        if found is None:
            raise ConfigError("[vision.cameras] names no cameras")
        return found

    @property
    def devices(self) -> dict[str, str]:
        """Devices by display name; empty if images come from files."""
        match self.layout:
            case OneConfig() as one:
                return {"camera": one.device}
            case TwoConfig() as two:
                return {"left camera": two.left, "right camera": two.right}
            case SideBySideConfig() as one:
                return {"stereo camera": one.device}
        return {}

    @property
    def eyes(self) -> int:
        """Number of eyes: 1 or 2."""
        match self.layout:
            case OneConfig():
                return 1
            case ImagesConfig() | VideosConfig() as files if files.right is None:
                return 2 if isinstance(files, VideosConfig) and files.side_by_side else 1
        return 2

    @property
    def sigma_s(self) -> float:
        """1-sigma of the latency [s]."""
        if self.latency_sigma_s is not None:
            return self.latency_sigma_s
        return UNKNOWN_LATENCY_SIGMA_S if self.devices or self.realsense is not None else 0.0

    @property
    def readout(self) -> tuple[float, float]:
        """Readout time of all rows and its 1-sigma [s]; an unknown readout is uniform within ± a frame interval."""
        if self.readout_s is not None:
            return self.readout_s, 0.0
        return 0.0, 1.0 / (self.layout.fps or 30.0) / math.sqrt(3.0)

    def check(self, file: Path, text: str, table: tuple[str, ...] = ("vision", "cameras")) -> None:
        """Raise ConfigError unless there is exactly one complete layout; `table` is the name of the table."""
        given = [name for name in LAYOUTS if getattr(self, name) is not None]

        def refuse(what: str, remedy: str, *keys: str) -> None:
            place = (*table, *keys)
            raise ConfigError(f"{'.'.join(place)}: {what}", file=file, line=line_of(text, place), remedy=remedy)

        if not given:
            refuse(
                "no cameras are named",
                "Add one of its tables one, two, side_by_side, realsense, images, videos: docs/cameras.md",
            )
        if len(given) > 1:
            refuse(f"images cannot come from both {given[0]} and {given[1]}", "Take one out", given[1])
        for name, device in self.devices.items():
            if ENUMERATED.fullmatch(device):
                key = name.split()[0] if self.two is not None else "device"
                refuse(
                    f"{device!r} may be another camera after the next plugging in",
                    "Name it as `ls /dev/v4l/by-id` does, or by-path where two have the same name",
                    given[0],
                    key,
                )
        if self.two is not None and self.two.left == self.two.right:
            refuse("both eyes are the same device", "Name two; one with two eyes is the table side_by_side", "two")
        if self.images is not None and _count(self.images, "times", "name_ticks_per_s", "fps") != 1:
            refuse("the times have to come from one thing", "Give times, name_ticks_per_s or fps", "images")
        if self.videos is not None:
            named = (self.videos.left is not None, self.videos.right is not None, self.videos.side_by_side is not None)
            if named not in ((True, True, False), (True, False, False), (False, False, True)):
                refuse("which films?", "Give left and right, side_by_side, or left alone for one camera", "videos")
            if _count(self.videos, "times", "fps") > 1:
                refuse("the times have to come from one thing", "Give times or fps", "videos")


class FurtherCameras(CamerasConfig, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A table [[vision.further_cameras]]: cameras that see the same marker from another position."""

    name: str  # in messages
    # xyz, rpy: pose of their left optical frame in the measurement frame, that of [vision.cameras] [m], [rad]
    xyz: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rpy: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @property
    def pose(self) -> FloatArray:
        """The pose, shape (4, 4)."""
        T = np.eye(4)
        T[:3, :3] = rotation_of(np.array(self.rpy))
        T[:3, 3] = self.xyz
        return T


def _count(table: msgspec.Struct, *keys: str) -> int:
    return sum(getattr(table, key) is not None for key in keys)
