"""What a recording says of camera, tool and joint zeros: a rigid chain learnt from it, in the terms of robot.toml."""

from __future__ import annotations

import math
from dataclasses import dataclass

import msgspec
import numpy as np
from numpy.typing import NDArray

from daemon.evaluate import aligned_chain
from interfaces.calibrated import CalibratedGeometry
from interfaces.errors import BodyschemaError
from interfaces.recording import Recording
from interfaces.records import FloatArray
from interfaces.robot import RobotDescription
from interfaces.rpy import rpy_of
from kbmaps import ChainParameters, ChainReport, ChainTolerances, KBMapsError, RigidLearner

BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.intp]

# How well arms are made: tilt of an axis [rad] and its shift [m], 1-sigma, from a milled arm to a kit. Which of them
# an arm is, its pairs tell. Steps of about three.
WORKMANSHIP = ((0.0003, 0.0001), (0.001, 0.0005), (0.003, 0.001), (0.01, 0.003), (0.03, 0.01), (0.06, 0.03))
# How many pairs are asked. No arm is quite rigid, and thousands of pairs would take its sag for bad workmanship.
JUDGED_PAIRS = 300
SLIDE_ZEROS_M = 0.02
# Of what is said to be known.
KNOWN_TURN_RAD, KNOWN_PLACE_M = 0.02, 0.01
# A zero that is still as uncertain as it was before is nothing that the pairs show.
NOT_SHOWN = 0.9
# A joint that moved less is named [rad, m].
STILL_RAD, STILL_M = math.radians(10.0), 0.02
# Of the numerical derivatives by tilts, shifts and zeros [rad, m].
_STEP = 1e-6
_HALF_WIDTH_95 = 1.959964
_UNITS = (1e3, 1e3, 1e3, *(math.degrees(1.0),) * 3, 1e3, 1e3, 1e3)


class CalibrationError(BodyschemaError):
    """A recording does not calibrate this robot."""


class Figure(msgspec.Struct, frozen=True):
    """One number as drawn and as learnt, with half the width of its 95 % interval."""

    drawn: float
    learnt: float
    half_width: float


class Zero(msgspec.Struct, frozen=True):
    """What has to be added to a joint's reading, in `unit` (° or mm).

    `half_width` of its 95 % interval is null where no motion shows it and it is left as drawn: the other figures are
    given that it is right.
    """

    joint: str
    unit: str
    zero: float
    half_width: float | None


class CalibrationReport(msgspec.Struct, frozen=True, kw_only=True):
    """The answers.

    Attributes:
        pairs: that were learnt, `outliers` of them left out.
        camera_link, camera_xyz_mm, camera_rpy_deg: pose of the measurement frame in this link (URDF convention).
        marker_link, marker_xyz_mm: the marker in this link.
        zeros: of the joints, in the order of q.
        noise_mm: 1-sigma of a measured coordinate, estimated or (`noise_told`) from the recording.
        misfit: residuals over what the told noise explains; 1 where it explains them, or was not told.
        drawn_error_mm: mean distance from the pairs to the drawn arm, with what robot.toml calls not known fitted.
        learnt_error_mm: mean distance to the learnt arm, over the same pairs, which it was fitted to.
        axes_deg, points_mm: how well the arm is made, by the pairs: 1-sigma of an axis' tilt and shift.
        shown: independent numbers of the arm that the pairs determine, of `showable` that positions can.
        still: joints that hardly moved.
    """

    robot: str
    source: str
    pairs: int
    outliers: int
    camera_link: str
    camera_xyz_mm: list[Figure]
    camera_rpy_deg: list[Figure]
    marker_link: str
    marker_xyz_mm: list[Figure]
    zeros: list[Zero]
    noise_mm: float
    noise_told: bool
    misfit: float
    drawn_error_mm: float
    learnt_error_mm: float
    axes_deg: float
    points_mm: float
    shown: int
    showable: int
    still: list[str]
    schema: int = 1


@dataclass(frozen=True, eq=False)
class Calibration:
    """A rigid chain learnt from a recording.

    Attributes:
        robot: the nominal model.
        recording: what was learnt.
        learner: what learnt it.
        geometry: the learnt chain in the terms of the robot's files.
    """

    robot: RobotDescription
    recording: Recording
    learner: RigidLearner
    geometry: CalibratedGeometry

    @classmethod
    def of(
        cls, robot: RobotDescription, recording: Recording, *, sigma_m: float | None, zeros_rad: float
    ) -> Calibration:
        """Learn `recording`, around the nominal model with tolerances that explain it best.

        Args:
            sigma_m: 1-sigma of the positions [m] where the recording has none; None: estimated.
            zeros_rad: how far joint zeros may be off (1-sigma) [rad].

        Raises:
            CalibrationError: there are too few pairs, or they do not fit the robot at all.
        """
        needed = 2 * len(robot.joints)
        if len(recording) < needed:
            raise CalibrationError(
                f"{len(recording)} pairs are too few to calibrate {len(robot.joints)} joints; record at least {needed}"
            )
        try:
            learner = _best_learner(robot, recording, sigma_m, zeros_rad)
            report = learner.report()
        except KBMapsError as error:
            raise CalibrationError(f"no chain can be fitted to the recording: {error}") from error
        geometry = CalibratedGeometry.of(
            robot, learner.chain, T_measured_nominal=report.T_measured_nominal, zeros=report.zeros.value
        )
        return cls(robot, recording, learner, geometry)

    def report(self, source: str) -> CalibrationReport:
        """The answers. EvaluationError: the drawn arm cannot be placed at all."""
        robot, learner, recording = self.robot, self.learner, self.recording
        report, tolerances, slides = learner.report(), learner.tolerances, robot.chain.prismatic
        zero_prior = np.where(slides, tolerances.slide_zeros, tolerances.zeros)
        shown = report.zeros.half_width < NOT_SHOWN * _HALF_WIDTH_95 * zero_prior
        half_width = self._half_widths(report, shown)
        drawn = CalibratedGeometry({}, robot.camera.pose, np.array(robot.robot.marker_xyz))
        figures = [
            Figure(unit * before, unit * after, unit * width)
            for unit, before, after, width in zip(
                _UNITS, _placed(drawn), _placed(self.geometry), half_width, strict=True
            )
        ]
        return CalibrationReport(
            robot=robot.name,
            source=source,
            pairs=len(recording),
            outliers=report.outliers,
            camera_link=robot.camera.parent_link,
            camera_xyz_mm=figures[:3],
            camera_rpy_deg=figures[3:6],
            marker_link=robot.robot.marker_link,
            marker_xyz_mm=figures[6:],
            zeros=_zeros(robot, report, shown),
            noise_mm=1e3 * report.noise,
            noise_told=recording.cov is not None,
            misfit=report.misfit,
            drawn_error_mm=1e3 * _mean_error(aligned_chain(robot, recording).positions(recording.q), recording),
            learnt_error_mm=1e3 * _mean_error(learner.predict(recording.q), recording),
            axes_deg=math.degrees(tolerances.axes),
            points_mm=1e3 * tolerances.points,
            shown=report.determined,
            # Everett and Hsu 1988: four for each joint that turns, two for each that slides, six for the ends of the
            # chain, less the three turns of the marker that its place does not show.
            showable=4 * int((~slides).sum()) + 2 * int(slides.sum()) + 3,
            still=_still(robot, recording),
        )

    def _half_widths(self, report: ChainReport, shown: BoolArray) -> FloatArray:
        """Half the 95 % intervals (9,) of `_placed`, given the zeros that the pairs do not show."""
        parameters, change = ChainParameters(self.learner.nominal), self.learner.change
        covariance = _given(self.learner.covariance, np.arange(parameters.size)[parameters.zeros][~shown])
        jacobian = np.empty((9, parameters.size))
        for k, step in enumerate(_STEP * np.eye(parameters.size)):
            ahead, behind = (self._placed_at(parameters, change + side) for side in (step, -step))
            difference = ahead - behind
            difference[3:6] = np.remainder(difference[3:6] + np.pi, 2.0 * np.pi) - np.pi
            jacobian[:, k] = difference / (2.0 * _STEP)
        std = np.sqrt(np.einsum("ij,jk,ik->i", jacobian, covariance, jacobian))
        # The noise was estimated: the learner's intervals are wider than its covariance by Student's factor.
        own = _HALF_WIDTH_95 * np.sqrt(np.diagonal(self.learner.covariance)[parameters.zeros])
        return _HALF_WIDTH_95 * std * float(np.divide(report.zeros.half_width, own).max())

    def _placed_at(self, parameters: ChainParameters, change: FloatArray) -> FloatArray:
        chain, zeros = parameters.chain(change), change[parameters.zeros]
        pose = parameters.base_pose(change)
        return _placed(CalibratedGeometry.of(self.robot, chain, T_measured_nominal=pose, zeros=zeros))


def _best_learner(
    robot: RobotDescription, recording: Recording, sigma_m: float | None, zeros_rad: float
) -> RigidLearner:
    """The learner of all pairs whose tolerances make some of them most probable (MacKay 1992, evidence)."""
    sigma = sigma_m if recording.cov is None else np.sqrt(np.trace(recording.cov, axis1=1, axis2=2) / 3.0)
    rows = np.unique(np.linspace(0, len(recording) - 1, JUDGED_PAIRS).astype(np.intp))

    def learner(tolerances: ChainTolerances, chosen: IntArray) -> RigidLearner:
        fresh = RigidLearner(robot.chain, tolerances)
        told = sigma if sigma is None else np.broadcast_to(sigma, len(recording))[chosen]
        fresh.learn(recording.q[chosen], recording.x[chosen], told)
        return fresh

    judged = [learner(tolerances, rows) for tolerances in _tolerances(robot, zeros_rad)]
    best = max(judged, key=lambda candidate: candidate.log_evidence)
    return learner(best.tolerances, np.arange(len(recording)))


def _tolerances(robot: RobotDescription, zeros_rad: float) -> list[ChainTolerances]:
    pose_known, marker_known = robot.camera.pose_known, robot.robot.marker_known
    return [
        ChainTolerances(
            axes=axes,
            points=points,
            zeros=zeros_rad,
            slide_zeros=SLIDE_ZEROS_M,
            tool=KNOWN_PLACE_M if marker_known else math.inf,
            base_rotation=KNOWN_TURN_RAD if pose_known else math.inf,
            base_translation=KNOWN_PLACE_M if pose_known else math.inf,
        )
        for axes, points in WORKMANSHIP
    ]


def _placed(geometry: CalibratedGeometry) -> FloatArray:
    """Camera xyz [m] and rpy [rad] in its link, and marker xyz [m] in its own (9,)."""
    camera = geometry.T_parent_camera
    return np.concatenate([camera[:3, 3], rpy_of(camera[:3, :3]), geometry.marker_xyz])


def _given(covariance: FloatArray, known: IntArray) -> FloatArray:
    """The covariance (m, m) of a Gaussian once some of its components are known."""
    across = covariance[:, known]
    return covariance - across @ np.linalg.solve(covariance[np.ix_(known, known)], across.T)


def _zeros(robot: RobotDescription, report: ChainReport, shown: BoolArray) -> list[Zero]:
    return [
        Zero(name, "mm" if slide else "°", unit * value, unit * half if known else None)
        for name, slide, value, half, known in zip(
            robot.joints, robot.chain.prismatic, report.zeros.value, report.zeros.half_width, shown, strict=True
        )
        for unit in (1e3 if slide else math.degrees(1.0),)
    ]


def _still(robot: RobotDescription, recording: Recording) -> list[str]:
    least = np.where(robot.chain.prismatic, STILL_M, STILL_RAD)
    moved = np.ptp(recording.q, axis=0)
    return [name for name, still in zip(robot.joints, moved < least, strict=True) if still]


def _mean_error(predicted: FloatArray, recording: Recording) -> float:
    return float(np.linalg.norm(predicted - recording.x, axis=1).mean())
