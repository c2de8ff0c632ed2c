"""The simulation's settings: [sim], with the marker of [vision]."""

from __future__ import annotations

from colorsys import hsv_to_rgb
from typing import TYPE_CHECKING, Any

import msgspec

from bodyschema.daemon.config import Config
from bodyschema.interfaces.camera import StereoCalibration
from bodyschema.interfaces.errors import ConfigError
from bodyschema.interfaces.records import MarkerFix, StereoFrame
from bodyschema.interfaces.rejections import WORDS

if TYPE_CHECKING:
    from bodyschema.sim_backend.config import CameraConfig, SimConfig, SimTag
    from bodyschema.vision.config import VisionConfig


class _Settings:
    # A painted ball: saturation, value; how far the room's hue gap exceeds the ball's band, and its minimum [deg].
    saturation, value, room_deg, gap_deg = 0.93, 0.86, 6.0, 36.0
    lamp, dimmed = 0.9, 0.45  # a ball detected by brightness glows; everything else is darker than half the threshold
    apart_s: float = 60.0  # a tracker has forgotten what it saw then


def simulation_settings(config: Config) -> SimConfig:
    """Return the table [sim], with the marker of [vision] in the hand unless [sim.camera] has another.

    Raises:
        ConfigError: the tracker does not find the simulated marker.
    """
    from bodyschema.sim_backend.config import CameraConfig

    sim, vision = config.tables.sim, config.tables.vision
    usual, marker = CameraConfig(), {} if sim.camera.tags else _marker(vision)
    unsaid = {name: value for name, value in marker.items() if getattr(sim.camera, name) == getattr(usual, name)}
    camera = msgspec.structs.replace(sim.camera, **unsaid)
    if vision.marker != "plugin" and config.robot.calibration is not None:
        _require_found(config, config.robot.calibration, camera)
    return msgspec.structs.replace(sim, camera=camera)


def _marker(vision: VisionConfig) -> dict[str, Any]:
    """Return the keys of [sim.camera] that show the marker of [vision]."""
    if vision.marker in ("tag", "cluster", "chessboard"):
        from bodyschema.vision.tags.dictionary import DICTIONARIES

        return {"tags": _tags(vision), "tag_dictionary": DICTIONARIES[vision.tag.dictionary]}
    ball = {"ball_radius_m": vision.radius_m}
    if vision.marker == "bright_ball":
        level = max(_Settings.lamp, (1.0 + vision.min_brightness) / 2)
        return {**ball, "ball_rgb": (level, level, level), "light": _Settings.dimmed * vision.min_brightness}
    band = vision.band
    # A lit ball is darker on one side, and its highlight is paler.
    saturation = max(_Settings.saturation, (1.0 + band.min_saturation) / 2)
    value = _Settings.value if band.min_value < _Settings.value / 2 else 1.0
    rgb = hsv_to_rgb(band.hue_deg / 360.0, saturation, value)
    gap_deg = max(_Settings.gap_deg, band.half_width_deg + _Settings.room_deg)
    return {**ball, "ball_rgb": rgb, "clutter_gap_deg": gap_deg}


def _require_found(config: Config, calibration: StereoCalibration, camera: CameraConfig) -> None:
    """Raise ConfigError if the tracker does not find the marker even alone in front of a plain wall."""
    from bodyschema.sim_backend.rendering.stereo_renderer import ball_portraits
    from bodyschema.vision.trackers import tracker_of

    tracker, reasons = tracker_of(calibration, config.tables.vision), []
    for t, images in enumerate(ball_portraits(calibration, camera)):
        seen = tracker.track(StereoFrame(_Settings.apart_s * t, images[0], images[1] if len(images) > 1 else None))
        if isinstance(seen, MarkerFix):
            return
        reasons.append(seen.reason)
    keys = {
        "chessboard": "[vision.chessboard]",
        "ball": "[vision.colour] or [vision] radius_m",
        "bright_ball": "[vision] min_brightness",
    }
    raise ConfigError(
        "the tracker would not find the marker of [vision] in the simulation's images, not even alone before a plain "
        f"wall: {WORDS[reasons[0]]}",
        file=config.file,
        remedy=f"Change {keys.get(config.tables.vision.marker, '[vision.tag]')}, or what [sim.camera] shows",
    )


def _tags(vision: VisionConfig) -> tuple[SimTag, ...]:
    from bodyschema.sim_backend.config import SimTag
    from bodyschema.vision.tags.config import PlacedTag

    if vision.marker == "chessboard":
        board, none = vision.board, (0.0, 0.0, 0.0)
        return (SimTag(id=0, xyz=none, rpy=none, side_m=board.square_m, squares=(board.columns, board.rows)),)
    placed = (PlacedTag(id=vision.tag.id),) if vision.marker == "tag" else vision.cluster.tags
    return tuple(SimTag(id=tag.id, xyz=tag.xyz, rpy=tag.rpy, side_m=tag.side_m or vision.tag.side_m) for tag in placed)
