"""The table [sim]: properties of the simulated robot, its sensors and the guiding hand."""

from __future__ import annotations

import math
from typing import Annotated

import msgspec
from msgspec import Meta

from bodyschema.robot.toml_file import Fraction, NonNegative, Positive

Rate = Annotated[int, Meta(ge=1, le=1000)]
# The ball where neither [sim.camera] nor [vision] describes one.
BALL_RADIUS_M, BALL_RGB = 0.02, (0.86, 0.07, 0.06)


class EncoderConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The table [sim.encoders]."""

    ticks_per_turn: Annotated[int, Meta(ge=1)] = 4096  # resolution of a revolute joint's encoder
    ticks_per_metre: Annotated[int, Meta(ge=1)] = 20_000  # resolution of a prismatic joint's encoder
    noise_ticks: NonNegative = 0.3  # 1-sigma of the noise that is added before a reading is rounded to whole ticks
    rate_hz: Rate = 120  # readings a second


class SimTag(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One of [[sim.camera.tags]]: a tag in the hand instead of the ball."""

    id: Annotated[int, Meta(ge=0)]  # its number
    xyz: tuple[float, float, float]  # its centre in the marker's frame [m]
    # how its frame (x right, y up, z out of it) is turned in the marker's [rad], URDF convention
    rpy: tuple[float, float, float]
    # side of its black square, or of each of a chessboard's [m]; the white margin is an eighth of a tag, or half a
    # square
    side_m: Positive
    squares: tuple[int, int] | None = None  # columns and rows of a plain chessboard in the place of a tag

    @property
    def half_sheet_m(self) -> tuple[float, float]:
        """Half the sides of the printed sheet [m]."""
        columns, rows = self.squares or (0.25, 0.25)
        return 0.5 * (columns + 1) * self.side_m, 0.5 * (rows + 1) * self.side_m


class CameraConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The table [sim.camera]."""

    rate_hz: Rate = 30  # stereo frames a second
    noise: NonNegative = 2.0  # 1-sigma of the image noise [grey levels]
    clutter: Annotated[int, Meta(ge=0, le=1000)] = 60  # number of coloured objects in the background; 0 is a plain wall
    # how brightly all but the marker is lit; with less than 1 a ball glows, as a lamp does
    light: Annotated[float, Meta(gt=0, le=1)] = 1.0
    ball_radius_m: Positive | None = None  # radius of the marker ball [m]; without this key, as [vision] has it
    ball_rgb: tuple[Fraction, Fraction, Fraction] | None = None  # its colour; without this key, as [vision] has it
    # smallest difference between the hue of anything in the background and the ball's [deg]
    clutter_gap_deg: Annotated[float, Meta(ge=0, le=100)] = 36.0
    # what is in the hand instead of the ball; without this table, what [vision] looks for
    tags: tuple[SimTag, ...] = ()
    tag_dictionary: Annotated[int, Meta(ge=0)] = 20  # OpenCV's number of the tags' dictionary

    @property
    def rgb(self) -> tuple[float, float, float]:
        """The ball's colour; red by default."""
        return self.ball_rgb or BALL_RGB

    @property
    def marker_radius_m(self) -> float:
        """Radius of the smallest sphere around the marker's origin that contains the marker [m]."""
        if not self.tags:
            return self.ball_radius_m or BALL_RADIUS_M
        return max(math.hypot(*tag.xyz, *tag.half_sheet_m) for tag in self.tags)


class ErrorConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The table [sim.errors]: 1-sigma of the random differences between the true robot and its description."""

    # zero position of each joint's encoder [rad] (m for a prismatic joint, a tenth of it)
    joint_offset_rad: NonNegative = 0.045
    link_length_m: NonNegative = 0.005  # each coordinate of each joint's place on its parent link [m]
    link_axis_rad: NonNegative = 0.01  # each component of the rotation of each joint's frame [rad]
    camera_position_m: NonNegative = 0.005  # each coordinate of the cameras' place [m]
    camera_rotation_rad: NonNegative = 0.02  # each component of their rotation [rad]
    tool_m: NonNegative = 0.01  # each coordinate of the marker's place on the hand [m]
    # each component of the marker's rotation on the hand [rad]; without effect for a ball
    tool_rotation_rad: NonNegative = 0.1


class GuideConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The table [sim.guide]: the virtual hand."""

    # speed in joint space, Euclidean norm over all learnt joints, the gaze's included [rad/s]
    speed_rad_s: Positive = 0.87
    gravity_compensation: bool = True  # the arm's drives bear its weight (zero-force mode); otherwise the hand has to


class ToolChange(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One of [[sim.tool_changes]]."""

    at_s: NonNegative  # simulated time of the change [s]
    marker_xyz: tuple[float, float, float]  # the new tool's marker in the marker link [m]


class SimConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The table [sim]."""

    seed: Annotated[int, Meta(ge=0)] = 2  # all that is random is drawn from it
    encoders: EncoderConfig = EncoderConfig()
    camera: CameraConfig = CameraConfig()
    errors: ErrorConfig = ErrorConfig()
    guide: GuideConfig = GuideConfig()
    # true: the simulated arm's angles come through the driver of [drivers], from emulated servos, encoders or a ROS 2
    # robot with their resolution; false: directly
    servo_bench: bool = False
    # tool changes at given simulated times, besides those that `SimWorld.change_tool` asks for
    tool_changes: tuple[ToolChange, ...] = ()
