"""A rigid chain learnt from a recording, in the terms of the robot's files, with its uncertainty."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from bodyschema.interfaces.errors import BodyschemaError
from bodyschema.interfaces.records import FloatArray
from bodyschema.learning.solvers.tolerance_selection import ToleranceSettings, probable_indices
from bodyschema.recordings.recording import Recording
from bodyschema.robot.description import RobotDescription
from kbmaps import (
    Alignment,
    ChainBelief,
    ChainParameters,
    ChainTolerances,
    KBMapsError,
    RigidChain,
    RigidLearner,
    align,
    rotation_matrices,
    unexplained_variance,
)
from kbmaps.robust import RobustSettings

from .chain_figures import ChainFigures, tolerances_determined

IntArray = NDArray[np.intp]
Trusted = Literal["nothing", "links", "urdf"]


class _Settings:
    # How many pairs are asked. No arm is quite rigid, and thousands of pairs would take its sag for bad workmanship.
    tolerance_pairs: int = 300
    slide_zeros_m: float = 0.02
    # A parameter counts as determined if its uncertainty falls below this share of the prior one.
    max_share: float = 1.0 / 3.0
    # Of what is said to be known, and of what is not, once it has been fitted: then far more than the fit can be off.
    known_turn_rad: float = 0.02
    known_place_m: float = 0.01
    fitted_turn_rad: float = 0.5
    fitted_place_m: float = 0.5
    # Number of cross-validation folds, each of two stretches far apart. Five leave four fifths of the rows to learn
    # from; more cost a fit each.
    folds: int = 5
    # Rows that one of these fits takes at most: figures of a millimetre do not change by more, and 20,000 take a
    # minute.
    fold_rows: int = 2000


@dataclass(frozen=True, slots=True)
class Expected:
    """Distances between prediction and measurement on held-out poses [m], without outliers."""

    mean_m: float
    p95_m: float


class CalibrationError(BodyschemaError):
    """A recording does not calibrate this robot."""


@dataclass(frozen=True, eq=False)
class Calibration:
    """A rigid chain learnt from a recording."""

    robot: RobotDescription  # the nominal model
    recording: Recording  # the learnt recording
    placed: Alignment  # the nominal chain with the unknowns of robot.toml fitted, from which learning started
    # of all pairs, with the tolerances that the pairs make probable, the most probable first
    learners: tuple[RigidLearner, ...]
    shares: FloatArray  # their probabilities (m,), which add up to 1
    noise_given: bool  # True if the noise was given, False if it was estimated
    trusted: Trusted = "nothing"  # the parts held at the URDF's values
    # errors (n, 3, k) [m] that all rows share, at 1 sigma of each of k unknowns; None if none are known
    common: FloatArray | None = None

    @classmethod
    def of(
        cls,
        robot: RobotDescription,
        recording: Recording,
        *,
        sigma_m: float | None,
        zeros_rad: float,
        trusted: Trusted = "nothing",
        common: Callable[[FloatArray], FloatArray] | None = None,
    ) -> Calibration:
        """Learn `recording`, around the nominal model.

        Args:
            sigma_m: 1-sigma of the positions [m] if the recording has none; None to estimate it.
            zeros_rad: 1-sigma of the joint offsets [rad].
            trusted: the parts held at the URDF's values: its links, or its joint offsets too.
            common: returns the errors (n, 3, k) [m] that all rows share at positions (n, 3) [m], at 1 sigma of each of
                k unknowns; None if none are known.

        Raises:
            CalibrationError: there are too few pairs, or they do not fit the robot at all.
        """
        needed = min_pairs(len(robot.joints), trusted)
        if len(recording) < needed:
            raise CalibrationError(
                f"{len(recording)} samples are too few to calibrate {len(robot.joints)} joints; "
                f"record at least {needed}"
            )
        known = {"pose_known": robot.camera.pose_known, "marker_known": robot.robot.marker_known}
        try:
            turned = recording.orientation
            turns = None if turned is None else rotation_matrices("orientation", turned)
            placed = align(robot.chain, recording.q, recording.x, turns=turns, **known)
            distance_m = float(np.linalg.norm(recording.x, axis=1).max())
            choices = _tolerances(robot, distance_m, zeros_rad, trusted)
            # Measured positions would share their noise with the rows.
            shared = None if common is None else common(placed.chain.positions(recording.q))
            learners, shares = _learners(placed.chain, choices, recording, sigma_m, shared)
            learners[0].report()  # fitted, so that it shows the errors that cannot be fitted
        except KBMapsError as error:
            raise CalibrationError(f"no chain can be fitted to the recording: {error}") from error
        stated = sigma_m is not None or recording.cov is not None
        return cls(robot, recording, placed, learners, shares, stated, trusted, shared)

    @property
    def learner(self) -> RigidLearner:
        return self.learners[0]

    @property
    def estimated_tolerances(self) -> ChainTolerances | None:
        """Estimated tolerances of the arm; None if the pairs do not determine them."""
        candidates = [(learner.tolerances.axes, learner.tolerances.points) for learner in self.learners]
        return self.learner.tolerances if tolerances_determined(candidates) else None

    @property
    def noise_m(self) -> float:
        """1-sigma of a measured coordinate [m], from the pairs' scatter around the learnt chain, without outliers."""
        report = self.learner.report()
        if not self.noise_given:
            return report.noise
        squares = np.sort(np.square(self.residuals).sum(axis=1))
        return float(np.sqrt(squares[: len(squares) - report.outliers].sum() / max(report.freedom, 1.0)))

    @property
    def residuals(self) -> FloatArray:
        """Measured minus predicted positions (n, 3) [m], without the estimated errors that all rows share."""
        return _residuals(self.learner, self.recording, np.arange(len(self.recording)), self.common)

    @cached_property
    def expected(self) -> Expected | None:
        """Errors on new poses, from contiguous held-out blocks; None if there are too few rows."""
        rows = len(self.recording)
        fold = np.arange(rows) * 2 * _Settings.folds // rows % _Settings.folds
        if rows < _Settings.folds * 2 * len(self.robot.joints):
            return None
        sigma_m = self.learner.report().noise if self.noise_given else None
        stated = _stated_covariances(self.recording, self.learner, np.arange(rows), self.common)
        distances = np.empty(rows)
        for held_out in range(_Settings.folds):
            kept = np.flatnonzero(fold != held_out)
            kept = kept[np.unique(np.linspace(0, len(kept) - 1, _Settings.fold_rows).astype(np.intp))]
            new_learner = RigidLearner(self.placed.chain, self.learner.tolerances)
            _learn(new_learner, self.recording, kept, sigma_m, stated, self.common)
            try:
                residuals = _residuals(new_learner, self.recording, np.flatnonzero(fold == held_out), self.common)
            except KBMapsError:
                return None
            distances[fold == held_out] = np.linalg.norm(residuals, axis=1)
        distances = distances[self.learner.inliers]
        return Expected(float(distances.mean()), float(np.quantile(distances, 0.95)))

    @cached_property
    def shown(self) -> int:
        """Number of independent parameters whose uncertainty the pairs reduce to less than a third (`max_share`).

        The prior allows an arm of the widest tolerances.
        """
        report, (axes, points) = self.learner.report(), ToleranceSettings.candidates[-1]
        parameters = ChainParameters(self.placed.chain)
        before = ChainBelief.from_tolerances(parameters, replace(self.learner.tolerances, axes=axes, points=points))
        _, jacobian = parameters.linearised(self.learner.change, self.recording.q)
        rows = (jacobian @ before.root).reshape(-1, before.root.shape[1]) / (report.noise * report.misfit)
        remaining_share = 1.0 / np.sqrt(1.0 + np.square(np.linalg.svd(rows, compute_uv=False)))
        return int((remaining_share < _Settings.max_share).sum())

    @cached_property
    def figures(self) -> ChainFigures:
        """Calibrated figures; their uncertainty includes that of the tolerances."""
        prior = ChainBelief.from_tolerances(ChainParameters(self.placed.chain), self.learner.tolerances)
        return ChainFigures(self.robot, tuple(map(_widened_belief, self.learners)), self.shares, prior)


def _learners(
    nominal: RigidChain,
    choices: list[ChainTolerances],
    recording: Recording,
    sigma_m: float | None,
    common: FloatArray | None,
) -> tuple[tuple[RigidLearner, ...], FloatArray]:
    """Return learners of all pairs for the tolerances that a sample of the pairs makes probable, and their weights."""
    stated = None if recording.cov is None else recording.cov + RobustSettings.rounding_m**2 * np.eye(3)
    sample = np.unique(np.linspace(0, len(recording) - 1, _Settings.tolerance_pairs).astype(np.intp))

    def learner(tolerances: ChainTolerances, rows: IntArray) -> RigidLearner:
        new_learner = RigidLearner(nominal, tolerances)
        _learn(new_learner, recording, rows, sigma_m, stated, common)
        return new_learner

    stated = _stated_covariances(recording, learner(choices[-1], sample), sample, common)
    evidence = np.array([learner(tolerances, sample).log_evidence for tolerances in choices])
    kept, shares = probable_indices(evidence)
    all_rows = np.arange(len(recording))
    return tuple(learner(choices[k], all_rows) for k in kept), shares


def _residuals(learner: RigidLearner, recording: Recording, rows: IntArray, common: FloatArray | None) -> FloatArray:
    residuals = recording.x[rows] - learner.predict(recording.q[rows])
    return residuals if common is None else residuals - common[rows] @ learner.unknowns


def _learn(
    learner: RigidLearner,
    recording: Recording,
    rows: IntArray,
    sigma_m: float | None,
    stated: FloatArray | None,
    common: FloatArray | None,
) -> None:
    noise = {"sigma": sigma_m} if stated is None else {"cov": stated[rows]}
    shared = None if common is None else common[rows]
    learner.learn(recording.q[rows], recording.x[rows], **noise, common=shared)


def _stated_covariances(
    recording: Recording, learner: RigidLearner, rows: IntArray, common: FloatArray | None
) -> FloatArray | None:
    """Return the stated covariances (n, 3, 3) [m²], the arm's share added in some rows; None if none are stated."""
    if recording.cov is None:
        return None
    return recording.cov + (RobustSettings.rounding_m**2 + _arm_variance(learner, recording, rows, common)) * np.eye(3)


def _arm_variance(learner: RigidLearner, recording: Recording, rows: IntArray, common: FloatArray | None) -> float:
    """Return the variance [m²] per coordinate of these rows beyond the instrument's: encoders, backlash."""
    assert recording.cov is not None
    good = rows[learner.inliers]
    residuals = _residuals(learner, recording, rows, common)[learner.inliers]
    freedom = max(learner.scatter.freedom, 1.0)
    return unexplained_variance(residuals, recording.cov[good] + RobustSettings.rounding_m**2 * np.eye(3), freedom)


def min_pairs(joints: int, trusted: Trusted) -> int:
    """Return the number of pairs needed: two for each joint, or twice the unknowns if the URDF is trusted."""
    unknowns = 9 + (joints if trusted == "links" else 0)
    return 2 * joints if trusted == "nothing" else min(2 * joints, math.ceil(2 * unknowns / 3))


def _tolerances(
    robot: RobotDescription, distance_m: float, zeros_rad: float, trusted: Trusted
) -> list[ChainTolerances]:
    """Return the candidate tolerances; the arm is `distance_m` from the origin of the measurement frame.

    The frame's pose is a rotation about this origin and a shift: from afar, a small rotation of the arm is a long
    shift.
    """
    links = ToleranceSettings.candidates if trusted == "nothing" else ((0.0, 0.0),)
    free_zeros = trusted != "urdf"
    pose_known, marker_known = robot.camera.pose_known, robot.robot.marker_known
    fitted_place_m = max(_Settings.fitted_place_m, _Settings.fitted_turn_rad * distance_m)
    return [
        ChainTolerances(
            axes=axes,
            points=points,
            zeros=zeros_rad if free_zeros else 0.0,
            slide_zeros=_Settings.slide_zeros_m if free_zeros else 0.0,
            tool=_Settings.known_place_m if marker_known else _Settings.fitted_place_m,
            base_rotation=_Settings.known_turn_rad if pose_known else _Settings.fitted_turn_rad,
            base_translation=_Settings.known_place_m if pose_known else fitted_place_m,
        )
        for axes, points in links
    ]


def _widened_belief(learner: RigidLearner) -> ChainBelief:
    """Return the learner's posterior, widened like its intervals to allow for an estimated noise level."""
    belief = learner.belief
    return replace(belief, root=learner.report().widening * belief.root)
