"""The learner's own figures, as its status message contains them."""

from __future__ import annotations

import msgspec

from bodyschema.robot.hand_eye import HandEye


class CurvePoint(msgspec.Struct, frozen=True, array_like=True):
    """One point of the learning curve: prequential error, before the pair was learnt."""

    pairs: int
    error_m: float


class LearntFigure(msgspec.Struct, frozen=True):
    """One value of the robot's files: nominal and learnt, with half the width of its 95 % interval."""

    drawn: float
    learnt: float
    half_width: float


class JointZero(msgspec.Struct, frozen=True):
    """Joint offset to add to a joint's reading, with half the width of its 95 % interval [rad or m]."""

    value: float
    half_width: float


class ChainCalibration(msgspec.Struct, frozen=True, kw_only=True):
    """Pose of camera and tool, and the joint offsets, by the learnt rigid chain.

    Attributes:
        pairs: number of pairs with the present tool used for it.
        camera_link, camera_xyz, camera_rpy: pose of the measurement frame in this link (URDF convention) [m, rad].
        marker_link, marker_xyz: the marker in this link [m].
        zeros: by joint; null where the offset is not identifiable and kept at nominal. The other figures assume that.
        axes_rad, points_m: estimated deviation from the URDF: 1-sigma of axis tilt and of axis shift; null where the
            pairs do not determine it.
        noise_m: 1-sigma of a measured coordinate.
        outliers: number of outliers among the last 500 pairs: too far from the chain for this noise.
        hand_eye: the camera's pose as ROS takes it; null from a learner of an earlier version.
        marker_covariance: of the marker in its link, 3 x 3 row by row [m²]; null likewise.
    """

    pairs: int
    camera_link: str
    camera_xyz: list[LearntFigure]
    camera_rpy: list[LearntFigure]
    marker_link: str
    marker_xyz: list[LearntFigure]
    zeros: dict[str, JointZero | None]
    axes_rad: float | None
    points_m: float | None
    noise_m: float
    outliers: int
    hand_eye: HandEye | None = None
    marker_covariance: list[float] | None = None


class Outlook(msgspec.Struct, frozen=True, kw_only=True):
    """Expected gain of further pairs.

    Attributes:
        pairs: pairs with the present tool used for the forecast.
        error_m: expected mean distance to the ground truth where the arm has been [m].
        least_error_m: the part of it that no further pair can reduce [m].
        anywhere_m: expected mean distance to the ground truth over the full ranges of all joints [m].
        further_pairs: numbers of further pairs, ascending.
        like_so_far_m: expected `error_m` after each number of further pairs, moving as so far [m].
        best_motion: the motion that would reduce the error most, in words.
        best_motion_m: expected `error_m` after each number of further pairs of that motion [m].
        enough: True if no motion, with as many pairs as the last of `further_pairs`, would lower `error_m` by a tenth,
            or by a tenth of a measurement's noise.
    """

    pairs: int
    error_m: float
    least_error_m: float
    anywhere_m: float
    further_pairs: list[int]
    like_so_far_m: list[float]
    best_motion: str
    best_motion_m: list[float]
    enough: bool


class OrientationStatus(msgspec.Struct, frozen=True):
    """The accuracy of the learnt marker orientation.

    Attributes:
        pairs: pairs with the present tool that have an orientation.
        answering: the model that answers.
        prequential_rad: recent mean angle between prediction and measurement, before learning [rad], by model.
        claimed_rad: predicted error angle [rad] within the support of the data; null before a few pairs.
    """

    pairs: int
    answering: str
    prequential_rad: dict[str, float]
    claimed_rad: float | None
