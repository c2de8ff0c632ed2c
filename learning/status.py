"""The learner's own figures and the last change, as its status message contains them."""

from __future__ import annotations

import msgspec

from bodyschema.robot.hand_eye import HandEye


class CurvePoint(msgspec.Struct, frozen=True, array_like=True):
    """One point of the learning curve: a list of two numbers."""

    pairs: int  # samples learnt
    error_m: float  # error on new samples then, before each was learnt [m]


class LearntFigure(msgspec.Struct, frozen=True):
    """One value of the robot's files, nominal and learnt."""

    drawn: float  # from robot.toml
    learnt: float  # from the samples
    half_width: float  # of its 95 % interval


class JointZero(msgspec.Struct, frozen=True):
    """Offset of a joint [rad; m for a prismatic joint]."""

    value: float  # to be added to the reading
    half_width: float  # of its 95 % interval


class ChainCalibration(msgspec.Struct, frozen=True, kw_only=True):
    """Camera, tool and joint offsets of the learnt rigid chain, updated seconds after new samples."""

    pairs: int  # samples with the present tool behind it
    camera_link: str  # the camera's parent link
    camera_xyz: list[LearntFigure]  # position of the measurement frame in that link [m]
    camera_rpy: list[LearntFigure]  # its orientation, as in URDF [rad]
    marker_link: str  # the link that carries the marker
    marker_xyz: list[LearntFigure]  # the marker (TCP) in that link [m]
    # joint offsets, by joint; null where not identifiable and kept at nominal, which the other figures assume
    zeros: dict[str, JointZero | None]
    # axes_rad, points_m: estimated deviation of axis directions [rad] and axis positions [m] from the URDF, 1-sigma;
    # null where the samples do not determine it
    axes_rad: float | None
    points_m: float | None
    noise_m: float  # 1-sigma of a measured coordinate [m]
    outliers: int  # among the last 500 samples: too far from the chain for this noise
    hand_eye: HandEye | None = None  # the camera's pose for ROS; null from a learner of an earlier version
    marker_covariance: list[float] | None = None  # of the marker in its link, 3 × 3 row by row [m²]; null likewise


class DataOutlook(msgspec.Struct, frozen=True, kw_only=True):
    """Expected gain of further samples."""

    pairs: int  # samples with the present tool behind it
    error_m: float  # claimed error where data is [m]
    least_error_m: float  # part of it that further samples cannot reduce [m]
    anywhere_m: float  # expected error over the full ranges of all joints [m]
    further_pairs: list[int]  # numbers of further samples, ascending
    like_so_far_m: list[float]  # `error_m` after each, with motion as so far [m]
    # most informative motion: `moving as so far`, `moving all joints over their ranges` or `moving JOINT over its
    # range`
    best_motion: str
    best_motion_m: list[float]  # `error_m` after each, with that motion [m]
    # no motion would gain a tenth of `error_m`, or of the measurement noise, with as many samples as the last of
    # `further_pairs`
    enough: bool


class OrientationStatus(msgspec.Struct, frozen=True):
    """Accuracy of the learnt marker orientation."""

    pairs: int  # samples with an orientation, with the present tool
    answering: str  # answering model
    # recent mean angle between prediction and new measurement, before learning, by model [rad]
    prequential_rad: dict[str, float]
    claimed_rad: float | None  # claimed mean angle to the truth where data is [rad]; null before a few samples


TOOL, CAMERA, JOINT = "tool", "camera", "joint"


class NamingSettings:
    named_probability = 0.95  # a kind at least this probable is named
    named_within_pairs = 500  # a change is named or renamed within this many samples; after them it stays as it is


class KindOfChange(msgspec.Struct, frozen=True):
    """Kind of change with its probability."""

    name: str  # `tool`, `camera`, `joint` or `other`
    joint: int | None  # index of the joint (from 0) whose offset changed; None for other kinds
    probability: float  # of this kind


class ChangeRecord(msgspec.Struct, frozen=True, kw_only=True):
    """Last change."""

    first_seq: int  # sequence number of the most probable first sample after it
    # earliest_seq, latest_seq: 95 % interval of that number
    earliest_seq: int
    latest_seq: int
    noticed_seq: int  # the sample at which it was detected; of a reported change, the last one before it
    found: bool  # True if it was detected in the samples, False if it was reported
    kinds: list[KindOfChange]  # possible kinds, the most probable first
    moved_m: float | None = None  # motion of the marker at the samples since, root mean square [m]; None if unknown

    @property
    def named(self) -> KindOfChange | None:
        """Named kind; None while undecided. Kinds that no motion can separate count together."""
        best = self.kinds[0]
        equivalent = [kind for kind in self.kinds[1:] if kind.name == self.alike(best) or self.alike(kind) == best.name]
        probability = best.probability + sum(kind.probability for kind in equivalent)
        return best if probability >= NamingSettings.named_probability else None

    def alike(self, kind: KindOfChange) -> str | None:
        """Return the kind that no motion can separate from this one.

        An offset of the last joint equals a displacement of the marker; one of the first joint equals a rotation of the
        camera.
        """
        joints = [each.joint for each in self.kinds if each.joint is not None]
        ends = {} if not joints else {0: CAMERA, max(joints): TOOL}
        return None if kind.joint is None else ends.get(kind.joint)

    @classmethod
    def reported(cls, last_seq: int) -> ChangeRecord:
        """Return the record of a reported tool change after the pair `last_seq`."""
        return cls._starting_at(last_seq + 1, last_seq, False, [KindOfChange(TOOL, None, 1.0)])

    @classmethod
    def unidentified(cls, first_seq: int, noticed_seq: int, joints: int) -> ChangeRecord:
        """Return the record of a change detected before the arm was known well enough to identify its kind."""
        kinds = [KindOfChange(name, None, 1.0 / 3.0) for name in (TOOL, CAMERA)]
        kinds += [KindOfChange(JOINT, joint, 1.0 / (3.0 * joints)) for joint in range(joints)]
        return cls._starting_at(first_seq, noticed_seq, True, kinds)

    @classmethod
    def _starting_at(cls, first: int, noticed: int, found: bool, kinds: list[KindOfChange]) -> ChangeRecord:
        return cls(first_seq=first, earliest_seq=first, latest_seq=first, noticed_seq=noticed, found=found, kinds=kinds)
