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
    """State of one process.

    Attributes:
        answers: true if it is alive now.
        endpoint: its expected endpoint.
        heard: time of its last message, UTC [s since 1970]; null before.
        problem: why its last message could not be decoded; null if it could.
        status: its last status, including fields unknown to this version; null before.
    """

    answers: bool
    endpoint: str
    heard: float | None
    problem: str | None
    status: dict[str, Any] | None


class SeriesDocument(msgspec.Struct, frozen=True):
    """Time series of figures since the view began, columns of equal length.

    Attributes:
        t: UTC [s since 1970].
        error_m: error on new pairs of the answering model [m], measurement noise included; null while there is none.
        expected_m: error that the learner expects on new pairs in its support, measurement noise included [m].
        pairs_per_s: accepted pairs.
        predict_s: round-trip time of one prediction [s]; null without an answer.
    """

    t: list[float]
    error_m: list[float | None]
    expected_m: list[float | None]
    pairs_per_s: list[float | None]
    predict_s: list[float | None]


class Change(msgspec.Struct, frozen=True):
    """Change of the tool, the camera or a joint offset.

    Attributes:
        pairs: number of pairs learnt before it.
        t: when the view received it, UTC [s since 1970].
        kind: as in the learner's status; null if learning restarted from the prior.
        told: true if it was reported, false if the learner detected it.
    """

    pairs: int
    t: float
    kind: str | None
    told: bool


class Version(msgspec.Struct, frozen=True):
    """Span of time in which the same kind of model answered.

    Attributes:
        since: UTC [s since 1970].
        first_pairs, pairs: pairs learnt when it began, and at last.
        answering: name of the model.
        model: hash of the newest of them.
        error_m: its error on new pairs [m].
        after_change: true if it began with a change of the tool.
    """

    since: float
    first_pairs: int
    pairs: int
    answering: str
    model: str
    error_m: float | None
    after_change: bool


class CourseDocument(msgspec.Struct, frozen=True):
    """Changes and answering models since the view began, the newest last."""

    changes: list[Change]
    versions: list[Version]


class Segment(msgspec.Struct, frozen=True):
    """Run of pairs.

    Attributes:
        segment: its number.
        pairs: their number.
        utc: when its first known pair was accepted, ISO 8601.
        lasted_s: from its first to its last pair.
        complete: true if its first pair is known.
    """

    segment: int
    pairs: int
    utc: str
    lasted_s: float
    complete: bool


class CloudDocument(msgspec.Struct, frozen=True):
    """Measured marker positions and the model's residuals there, for learnt pairs.

    Attributes:
        model: hash of the queried model; empty while none answers.
        x: measured positions [m], measurement frame.
        residual: measured - predicted [m].
        segment: of each row.
        median_m, p95_m: of the residuals' lengths; null without rows.
    """

    model: str
    x: list[list[float]]
    residual: list[list[float]]
    segment: list[int]
    median_m: float | None
    p95_m: float | None


class OutlookDocument(msgspec.Struct, frozen=True):
    """Expected gain of further pairs. All errors are those expected on new pairs, measurement noise included [m].

    Attributes:
        sentence: advice in words.
        pairs: number of pairs that the forecast rests on.
        now_m: where the arm has been, after these pairs.
        further_pairs: numbers of further pairs.
        like_so_far_m: after each number of further pairs, moving as so far.
        best_motion: the motion that would reduce the error most, in words.
        best_motion_m: after each number of further pairs of that motion.
    """

    sentence: str
    pairs: int
    now_m: float
    further_pairs: list[int]
    like_so_far_m: list[float]
    best_motion: str
    best_motion_m: list[float]


class ArmDocument(msgspec.Struct, frozen=True):
    """The arm at its newest pair, in the root link's frame [m].

    Attributes:
        pair: sequence number of the pair.
        links: pose of each link of the body document: x, y, z, and the quaternion's x, y, z, w.
        camera: pose of the measurement frame.
        hand: number of the link that holds the marker.
        measured: the marker as it was measured.
        measured_pose, predicted_pose: measurement and prediction in the measurement frame, as all messages have poses;
            null without a prediction.
        trail: where it was measured in the pairs before, the newest last.
        predicted: the marker by the answering model; null without one.
        radii: half axes of the ellipsoid around it, along the measurement frame's axes, in which 95 % of measurements
            should lie by the learner's estimate; null without a prediction, or while the noise is unknown.
        apart_m: distance of measurement and prediction. The pair may be learnt already.
        placed: true if the camera's pose is known.
    """

    pair: int
    links: list[list[float]]
    camera: list[float]
    hand: int
    measured: list[float]
    trail: list[list[float]]
    predicted: list[float] | None
    measured_pose: MarkerPose
    predicted_pose: MarkerPose | None
    radii: list[float] | None
    apart_m: float | None
    placed: bool


class LinkShape(msgspec.Struct, frozen=True):
    """A visual shape of a link.

    Attributes:
        kind: box, sphere, cylinder, capsule or mesh. Cylinders and capsules lie along z.
        sizes: edges of a box; radius; radius and length [m].
        pose: in its link, as in `ArmDocument`.
        rgba: its colour; null where the URDF gives none.
        mesh: number of its mesh; null for other kinds.
    """

    kind: str
    sizes: list[float]
    pose: list[float]
    rgba: list[float] | None
    mesh: int | None


class CameraShape(msgspec.Struct, frozen=True):
    """Field of view of the cameras.

    Attributes:
        eyes: places of the cameras in the measurement frame [m].
        edges: left, right, upper and lower end of the image at a distance of 1 m.
    """

    eyes: list[list[float]]
    edges: list[float]


class BodyDocument(msgspec.Struct, frozen=True):
    """The robot as it looks; constant.

    Attributes:
        links: names.
        shapes: of each link.
        rods: pairs of links between whose origins a rod stands for shapes that are not there.
        moving: links that a moving joint carries.
        camera: null where robot.toml does not describe the cameras.
        said: what is not shown as the URDF has it, in sentences.
    """

    links: list[str]
    shapes: list[list[LinkShape]]
    rods: list[tuple[int, int]]
    moving: list[int]
    camera: CameraShape | None
    said: list[str]


class DiagnosisDocument(msgspec.Struct, frozen=True):
    """State of the last requested diagnosis.

    Attributes:
        number: of the diagnosis, from 1; 0 before any.
        state: idle, copying (pairs from the sampler), running, done, failed or stopped.
        pairs: number of pairs.
        said: current step, result, or error.
        started: UTC [s since 1970].
        verdict: of diagnosis.json; null unless it is done.
        report: number of the diagnosis whose report is available; null if there is none.
    """

    number: int = 0
    state: Literal["idle", "copying", "running", "done", "failed", "stopped"] = "idle"
    pairs: int = 0
    said: str = ""
    started: float | None = None
    verdict: str | None = None
    report: int | None = None
