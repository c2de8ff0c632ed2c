"""The learner's own figures, as its status message contains them."""

from __future__ import annotations

import msgspec

from bodyschema.robot.hand_eye import HandEye


class CurvePoint(msgspec.Struct, frozen=True, array_like=True):
    """One point of the learning curve: a list of two numbers.

    Attributes:
        pairs: pairs learnt.
        error_m: error on new pairs then, before each was learnt [m].
    """

    pairs: int
    error_m: float


class LearntFigure(msgspec.Struct, frozen=True):
    """One value of the robot's files, nominal and learnt.

    Attributes:
        drawn: from robot.toml.
        learnt: from the pairs.
        half_width: of its 95 % interval.
    """

    drawn: float
    learnt: float
    half_width: float


class JointZero(msgspec.Struct, frozen=True):
    """Offset of a joint [rad, of a prismatic joint m].

    Attributes:
        value: to be added to the reading.
        half_width: of its 95 % interval.
    """

    value: float
    half_width: float


class ChainCalibration(msgspec.Struct, frozen=True, kw_only=True):
    """Camera, tool and joint offsets of the learnt rigid chain, updated seconds after new pairs.

    Attributes:
        pairs: pairs with the present tool behind it.
        camera_link: the camera's parent link.
        camera_xyz: position of the measurement frame in that link [m].
        camera_rpy: its orientation, as in URDF [rad].
        marker_link: the link that carries the marker.
        marker_xyz: the marker (TCP) in that link [m].
        zeros: joint offsets, by joint; null where not identifiable and kept at nominal, which the other figures assume.
        axes_rad, points_m: estimated deviation of axis directions [rad] and axis positions [m] from the URDF, 1-sigma;
            null where the pairs do not determine it.
        noise_m: 1-sigma of a measured coordinate [m].
        outliers: among the last 500 pairs: too far from the chain for this noise.
        hand_eye: the camera's pose as ROS takes it; null from a learner of an earlier version.
        marker_covariance: of the marker in its link, 3 × 3 row by row [m²]; null likewise.
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
        pairs: pairs with the present tool behind it.
        error_m: claimed error where data is [m].
        least_error_m: part of it that further pairs cannot reduce [m].
        anywhere_m: expected error over the full ranges of all joints [m].
        further_pairs: numbers of further pairs, ascending.
        like_so_far_m: `error_m` after each, with motion as so far [m].
        best_motion: most informative motion: `moving as so far`, `moving all joints over their ranges` or
            `moving JOINT over its range`.
        best_motion_m: `error_m` after each, with that motion [m].
        enough: no motion would gain a tenth of `error_m`, or of the measurement noise, with as many pairs as the last
            of `further_pairs`.
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
    """Accuracy of the learnt marker orientation.

    Attributes:
        pairs: pairs with an orientation, with the present tool.
        answering: answering model.
        prequential_rad: recent mean angle between prediction and new measurement, before learning, by model [rad].
        claimed_rad: claimed mean angle to the truth where data is [rad]; null before a few pairs.
    """

    pairs: int
    answering: str
    prequential_rad: dict[str, float]
    claimed_rad: float | None
