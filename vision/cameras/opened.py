"""Create the cameras of [vision.cameras]."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from bodyschema.interfaces.protocols import Clock

from .config import CamerasConfig, ImagesConfig, OneConfig, RealsenseConfig, SideBySideConfig, TwoConfig, VideosConfig
from .image_reader import ImageReader
from .live import LiveEyes
from .realsense import RealsenseCamera
from .recorded_eyes import FrameReader, RecordedEyes
from .v4l2.device import OpenCapture, open_v4l2
from .videos import VideoReader


def eyes_of(
    config: CamerasConfig, folder: Path, clock: Clock, open_capture: OpenCapture = open_v4l2
) -> LiveEyes | RealsenseCamera | RecordedEyes:
    """Create the configured cameras or files as `StereoEyes`, not opened yet.

    Args:
        folder: folder of robot.toml; files are named relative to it.
        clock: the machine's monotonic clock.
    """
    match config.layout:
        case OneConfig() | TwoConfig() | SideBySideConfig() as layout:
            return LiveEyes(config, layout, clock, open_capture)
        case RealsenseConfig() as realsense:
            return RealsenseCamera(config, realsense, clock)
        case ImagesConfig() as images:
            return _recorded_eyes(config, lambda: ImageReader(images, folder), clock, images.speed)
        case VideosConfig() as videos:
            return _recorded_eyes(config, lambda: VideoReader(videos, folder), clock, videos.speed)


def _recorded_eyes(
    config: CamerasConfig, reader: Callable[[], FrameReader], clock: Clock, speed: float
) -> RecordedEyes:
    return RecordedEyes(reader, clock, speed=speed, latency_s=config.latency_s, sigma_s=config.sigma_s)
