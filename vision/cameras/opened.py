"""Create the cameras of [vision.cameras]."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from bodyschema.interfaces.protocols import Clock

from .config import CamerasConfig, ImagesConfig, OneConfig, RealsenseConfig, SideBySideConfig, TwoConfig, VideosConfig
from .film import Film, Roll
from .image_roll import ImageRoll
from .live import LiveEyes
from .realsense import RealsenseCamera
from .v4l2.device import OpenCapture, open_v4l2
from .videos import VideoRoll


def eyes_of(
    config: CamerasConfig, folder: Path, clock: Clock, open_capture: OpenCapture = open_v4l2
) -> LiveEyes | RealsenseCamera | Film:
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
            return _film(config, lambda: ImageRoll(images, folder), clock, images.speed)
        case VideosConfig() as videos:
            return _film(config, lambda: VideoRoll(videos, folder), clock, videos.speed)


def _film(config: CamerasConfig, roll: Callable[[], Roll], clock: Clock, speed: float) -> Film:
    return Film(roll, clock, speed=speed, latency_s=config.latency_s, sigma_s=config.sigma_s)
