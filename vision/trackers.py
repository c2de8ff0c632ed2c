"""Create the tracker for the marker of [vision]."""

from __future__ import annotations

from bodyschema.interfaces.camera import StereoCalibration
from bodyschema.interfaces.errors import ConfigError
from bodyschema.robot.plugins import load
from bodyschema.vision.ball.one_eye import OneEyeBallTracker
from bodyschema.vision.ball.tracker import StereoTracker

from .config import VisionConfig
from .tracked_camera import MarkerTracker


def tracker_of(calibration: StereoCalibration, config: VisionConfig) -> MarkerTracker:
    """Create a tracker for rectified images of `calibration`, of two eyes or one.

    Raises:
        ConfigError: the calibration does not describe cameras, or the marker is impossible.
    """
    match config.marker:
        case "ball" | "bright_ball":
            return (StereoTracker if calibration.is_stereo else OneEyeBallTracker)(calibration, config)
        case "tag" | "cluster" | "chessboard":
            # They import scipy, which takes half a second; tracking a ball does not need it.
            from bodyschema.vision.tags.body import TagBody
            from bodyschema.vision.tags.chessboard import ChessboardFinder
            from bodyschema.vision.tags.tracker import TagTracker

            board = ChessboardFinder(config.board) if config.marker == "chessboard" else None
            return TagTracker(calibration, TagBody.of(config), config.tag, board, *config.readout)
        case "plugin":
            if config.plugin is None:
                raise ConfigError('[vision] marker = "plugin" names none', remedy="Add [vision.plugin] with its name")
            return load("bodyschema.trackers", config.plugin.name)(calibration, config.plugin.settings)
