"""Documents of the page, besides both processes' own states."""

from __future__ import annotations

from typing import Any, Literal

import msgspec

from bodyschema.robot.hand_eye import MarkerPose

Process = Literal["sampler", "learner"]


class RobotDocument(msgspec.Struct, frozen=True):
    """Constants: the robot's name, its joints, its prismatic joints, and the version of this software."""

    robot: str
    joints: tuple[str, ...]
    slides: tuple[str, ...]
    version: str


class ProcessDocument(msgspec.Struct, frozen=True):
    answers: bool  # true if it is alive now
    endpoint: str  # its expected endpoint
    heard: float | None  # time of its last message, UTC [s since 1970]; null before
    problem: str | None  # why its last message could not be decoded; null if it could
    status: dict[str, Any] | None  # its last status, including fields unknown to this version; null before


class SeriesDocument(msgspec.Struct, frozen=True):
    """Time series of figures since the view began, columns of equal length."""

    t: list[float]  # UTC [s since 1970]
    # error on new samples of the answering model [m], measurement noise included; null if missing
    error_m: list[float | None]
    # error that the learner expects on new pairs in its support, measurement noise included [m]
    expected_m: list[float | None]
    pairs_per_s: list[float | None]  # accepted pairs
    predict_s: list[float | None]  # round-trip time of one prediction [s]; null without an answer


class Change(msgspec.Struct, frozen=True):
    """Change of the tool, the camera or a joint offset."""

    pairs: int  # number of pairs learnt before it
    t: float  # when the view received it, UTC [s since 1970]
    kind: str | None  # as in the learner's status; null if learning restarted from the prior
    told: bool  # true if it was reported, false if the learner detected it


class Version(msgspec.Struct, frozen=True):
    """Span of time in which the same kind of model answered."""

    since: float  # UTC [s since 1970]
    # first_pairs, pairs: pairs learnt when it began, and at last
    first_pairs: int
    pairs: int
    answering: str  # name of the model
    model: str  # hash of the newest of them
    error_m: float | None  # its error on new pairs [m]
    after_change: bool  # true if it began with a change of the tool


class CourseDocument(msgspec.Struct, frozen=True):
    """Changes and answering models since the view began, the newest last."""

    changes: list[Change]
    versions: list[Version]


class Segment(msgspec.Struct, frozen=True):
    """Run of pairs."""

    segment: int  # its number
    pairs: int  # their number
    utc: str  # when its first known pair was accepted, ISO 8601
    lasted_s: float  # from its first to its last pair
    complete: bool  # true if its first pair is known


class CloudDocument(msgspec.Struct, frozen=True):
    """Measured marker positions and the model's residuals there, for learnt pairs."""

    model: str  # hash of the queried model; empty while none answers
    x: list[list[float]]  # measured positions [m], measurement frame
    residual: list[list[float]]  # measured - predicted [m]
    segment: list[int]  # of each row
    # median_m, p95_m: of the residuals' lengths; null without rows
    median_m: float | None
    p95_m: float | None


class OutlookDocument(msgspec.Struct, frozen=True):
    """Expected gain of further pairs. All errors are those expected on new pairs, measurement noise included [m]."""

    sentence: str  # advice in words
    pairs: int  # number of pairs that the forecast rests on
    now_m: float  # where the arm has been, after these pairs
    further_pairs: list[int]  # numbers of further pairs
    like_so_far_m: list[float]  # after each number of further pairs, moving as so far
    best_motion: str  # the motion that would reduce the error most, in words
    best_motion_m: list[float]  # after each number of further pairs of that motion


class ArmDocument(msgspec.Struct, frozen=True):
    """The arm at its newest pair, in the root link's frame [m]."""

    pair: int  # sequence number of the pair
    links: list[list[float]]  # pose of each link of the body document: x, y, z, and the quaternion's x, y, z, w
    camera: list[float]  # pose of the measurement frame
    hand: int  # number of the link that holds the marker
    measured: list[float]  # the marker as it was measured
    trail: list[list[float]]  # where it was measured in the pairs before, the newest last
    predicted: list[float] | None  # the marker by the answering model; null without one
    # measured_pose, predicted_pose: measurement and prediction in the measurement frame, as all messages have poses;
    # null without a prediction
    measured_pose: MarkerPose
    predicted_pose: MarkerPose | None
    # half axes, along the measurement frame's axes, of the ellipsoid around it that should contain 95 % of measurements
    # by the learner's estimate; null without a prediction, or while the noise is unknown
    radii: list[float] | None
    apart_m: float | None  # distance of measurement and prediction. The pair may be learnt already.
    placed: bool  # true if the camera's pose is known


class LinkShape(msgspec.Struct, frozen=True):
    kind: str  # box, sphere, cylinder, capsule or mesh. Cylinders and capsules lie along z.
    sizes: list[float]  # edges of a box; radius; radius and length [m]
    pose: list[float]  # in its link, as in `ArmDocument`
    rgba: list[float] | None  # its colour; null where the URDF gives none
    mesh: int | None  # number of its mesh; null for other kinds


class CameraShape(msgspec.Struct, frozen=True):
    """Field of view of the cameras."""

    eyes: list[list[float]]  # places of the cameras in the measurement frame [m]
    edges: list[float]  # left, right, upper and lower end of the image at a distance of 1 m


class BodyDocument(msgspec.Struct, frozen=True):
    """The robot as it looks; constant."""

    links: list[str]  # names
    shapes: list[list[LinkShape]]
    rods: list[tuple[int, int]]  # pairs of links joined by a rod, which replaces missing shapes
    moving: list[int]  # links that a moving joint carries
    camera: CameraShape | None  # null where robot.toml does not describe the cameras
    said: list[str]  # differences from the URDF, in sentences


class DiagnosisDocument(msgspec.Struct, frozen=True):
    """State of the last requested diagnosis."""

    number: int = 0  # of the diagnosis, from 1; 0 before any
    # idle, copying (pairs from the sampler), running, done, failed or stopped
    state: Literal["idle", "copying", "running", "done", "failed", "stopped"] = "idle"
    pairs: int = 0  # number of pairs
    said: str = ""  # current step, result, or error
    started: float | None = None  # UTC [s since 1970]
    verdict: str | None = None  # of diagnosis.json; null unless it is done
    report: int | None = None  # number of the diagnosis whose report is available; null if missing
