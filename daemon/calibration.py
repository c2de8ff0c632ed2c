"""A rigid chain learnt from a recording, in the terms of the robot's files, and how sure its numbers are."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from interfaces.calibrated import CalibratedGeometry
from interfaces.errors import BodyschemaError
from interfaces.recording import Recording
from interfaces.records import FloatArray
from interfaces.robot import RobotDescription
from interfaces.rpy import rpy_of
from kbmaps import Alignment, ChainParameters, ChainTolerances, KBMapsError, RigidChain, RigidLearner, align

BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.intp]

# How well arms are made: tilt of an axis [rad] and its shift [m], 1-sigma, from a milled arm to a kit. Which of them
# an arm is, its pairs tell.
WORKMANSHIP = ((0.0003, 0.0001), (0.001, 0.0005), (0.003, 0.001), (0.01, 0.003), (0.03, 0.01), (0.06, 0.03))
# How many pairs are asked. No arm is quite rigid, and thousands of pairs would take its sag for bad workmanship.
JUDGED_PAIRS = 300
# Workmanship that is less probable than this is not considered.
LEAST_SHARE = 0.01
SLIDE_ZEROS_M = 0.02
# Of what is said to be known, and of what is not, once it has been fitted: then far more than the fit can be off.
KNOWN_TURN_RAD, KNOWN_PLACE_M = 0.02, 0.01
FITTED_TURN_RAD, FITTED_PLACE_M = 0.5, 0.5
# A zero that is still as uncertain as it was before is nothing that the pairs show.
NOT_SHOWN = 0.9
HALF_WIDTH_95 = 1.959964
# Of the numerical derivatives by tilts, shifts and zeros [rad, m].
_STEP = 1e-6


class CalibrationError(BodyschemaError):
    """A recording does not calibrate this robot."""


@dataclass(frozen=True, eq=False)
class Calibration:
    """A rigid chain learnt from a recording.

    Attributes:
        robot: the nominal model.
        recording: what was learnt.
        placed: the nominal chain with what robot.toml calls not known fitted: what learning started from.
        learners: of all pairs, with the tolerances that the pairs make probable, the most probable first.
        shares: how probable each is (m,); they add up to 1.
        noise_told: whether the noise was told, not estimated.
    """

    robot: RobotDescription
    recording: Recording
    placed: Alignment
    learners: tuple[RigidLearner, ...]
    shares: FloatArray
    noise_told: bool

    @classmethod
    def of(
        cls, robot: RobotDescription, recording: Recording, *, sigma_m: float | None, zeros_rad: float
    ) -> Calibration:
        """Learn `recording`, around the nominal model.

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
        known = {"pose_known": robot.camera.pose_known, "marker_known": robot.robot.marker_known}
        try:
            placed = align(robot.chain, recording.q, recording.x, **known)
            learners, shares = _learners(placed.chain, _tolerances(robot, zeros_rad), recording, sigma_m)
            learners[0].report()  # fits it, so that what cannot be fitted shows here
        except KBMapsError as error:
            raise CalibrationError(f"no chain can be fitted to the recording: {error}") from error
        return cls(robot, recording, placed, learners, shares, sigma_m is not None or recording.cov is not None)

    @property
    def learner(self) -> RigidLearner:
        """The most probable one."""
        return self.learners[0]

    @property
    def geometry(self) -> CalibratedGeometry:
        """The learnt chain in the terms of the robot's files."""
        return self._geometry(self.learner.change)

    @property
    def figures(self) -> FloatArray:
        """Camera xyz [m] and rpy [rad] in its link, marker xyz [m] in its own, joint zeros [rad, m]: (9 + d,)."""
        return self._figures(self.learner.change)

    @property
    def half_widths(self) -> FloatArray:
        """Half the 95 % intervals (9 + d,) of `figures`, given that zeros which are not `shown` are right.

        Not knowing how well the arm is made is part of them: they are of the mixture of the learners' answers.
        """
        figures, variance = self.figures, np.zeros(9 + self.learner.joints)
        for learner, share in zip(self.learners, self.shares, strict=True):
            jacobian = self._derivatives(learner.change)
            covariance = _given(_claimed_covariance(learner), self._zeros[~self.shown])
            apart = _unwound(self._figures(learner.change) - figures)
            variance += share * (np.einsum("ij,jk,ik->i", jacobian, covariance, jacobian) + np.square(apart))
        return HALF_WIDTH_95 * np.sqrt(variance)

    @property
    def shown(self) -> BoolArray:
        """Which joints' zeros (d,) the pairs show; a turn of the camera or of the marker may do what others do."""
        tolerances = self.learner.tolerances
        before = np.where(self.robot.chain.prismatic, tolerances.slide_zeros, tolerances.zeros)
        return self.learner.report().zeros.half_width < NOT_SHOWN * HALF_WIDTH_95 * before

    @property
    def _zeros(self) -> IntArray:
        parameters = self._parameters
        return np.arange(parameters.size)[parameters.zeros]

    @cached_property
    def _parameters(self) -> ChainParameters:
        return ChainParameters(self.placed.chain)

    def _geometry(self, change: FloatArray) -> CalibratedGeometry:
        parameters = self._parameters
        return CalibratedGeometry.of(
            self.robot,
            parameters.chain(change),
            T_measured_nominal=parameters.base_pose(change) @ self.placed.T_measured_nominal,
            zeros=change[parameters.zeros],
        )

    def _figures(self, change: FloatArray) -> FloatArray:
        geometry = self._geometry(change)
        camera = geometry.T_parent_camera
        return np.concatenate([camera[:3, 3], rpy_of(camera[:3, :3]), geometry.marker_xyz, change[self._zeros]])

    def _derivatives(self, change: FloatArray) -> FloatArray:
        steps = _STEP * np.eye(len(change))
        columns = [_unwound(self._figures(change + step) - self._figures(change - step)) for step in steps]
        return np.array(columns).T / (2.0 * _STEP)


def _learners(
    nominal: RigidChain, choices: list[ChainTolerances], recording: Recording, sigma_m: float | None
) -> tuple[tuple[RigidLearner, ...], FloatArray]:
    """Learners of all pairs whose tolerances make some of the pairs probable, and their shares.

    By the marginal likelihood (MacKay 1992, "Bayesian interpolation").
    """
    sigma = sigma_m if recording.cov is None else np.sqrt(np.trace(recording.cov, axis1=1, axis2=2) / 3.0)
    some = np.unique(np.linspace(0, len(recording) - 1, JUDGED_PAIRS).astype(np.intp))

    def learner(tolerances: ChainTolerances, rows: IntArray) -> RigidLearner:
        fresh = RigidLearner(nominal, tolerances)
        told = None if sigma is None else np.broadcast_to(sigma, len(recording))[rows]
        fresh.learn(recording.q[rows], recording.x[rows], told)
        return fresh

    evidence = np.array([learner(tolerances, some).log_evidence for tolerances in choices])
    shares = np.exp(evidence - evidence.max())
    shares /= shares.sum()
    kept = [k for k in np.argsort(-shares) if shares[k] > LEAST_SHARE]
    everything = np.arange(len(recording))
    return tuple(learner(choices[k], everything) for k in kept), shares[kept] / shares[kept].sum()


def _tolerances(robot: RobotDescription, zeros_rad: float) -> list[ChainTolerances]:
    pose_known, marker_known = robot.camera.pose_known, robot.robot.marker_known
    return [
        ChainTolerances(
            axes=axes,
            points=points,
            zeros=zeros_rad,
            slide_zeros=SLIDE_ZEROS_M,
            tool=KNOWN_PLACE_M if marker_known else FITTED_PLACE_M,
            base_rotation=KNOWN_TURN_RAD if pose_known else FITTED_TURN_RAD,
            base_translation=KNOWN_PLACE_M if pose_known else FITTED_PLACE_M,
        )
        for axes, points in WORKMANSHIP
    ]


def _claimed_covariance(learner: RigidLearner) -> FloatArray:
    """The learner's covariance (size, size), as much wider as its intervals are where the noise was estimated."""
    parameters = ChainParameters(learner.nominal)
    own = HALF_WIDTH_95 * np.sqrt(np.diagonal(learner.covariance)[parameters.zeros])
    return learner.covariance * float(np.square(learner.report().zeros.half_width / own).max())


def _given(covariance: FloatArray, known: IntArray) -> FloatArray:
    """The covariance (m, m) of a Gaussian once some of its components are known."""
    across = covariance[:, known]
    return covariance - across @ np.linalg.solve(covariance[np.ix_(known, known)], across.T)


def _unwound(difference: FloatArray) -> FloatArray:
    """A difference of figures (9 + d,) whose camera angles go the shorter way round."""
    difference[3:6] = np.remainder(difference[3:6] + np.pi, 2.0 * np.pi) - np.pi
    return difference
