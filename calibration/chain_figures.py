"""Express the posterior of a chain in named parameters: camera pose, marker position, joint offsets."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from bodyschema.interfaces.records import FloatArray
from bodyschema.robot.calibrated import CalibratedGeometry
from bodyschema.robot.description import RobotDescription
from bodyschema.robot.hand_eye import HandEye, pose_covariance
from bodyschema.robot.rpy import pose_of, rpy_of
from bodyschema.robot.urdf import inverse
from kbmaps import ChainBelief, ChainParameters
from kbmaps.robust import HALF_WIDTH_95

BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.intp]


class _Settings:
    max_ratio: float = 4.0  # where what is probable differs by more than this, the pairs do not tell
    min_unidentified_share: float = (
        0.9  # a zero that is still as uncertain as it was before is nothing that the pairs show
    )
    step: float = 1e-6  # of the numerical derivatives by tilts, shifts and zeros [rad, m]
    # Poses that stand for all, and the noise of exact pairs [m].
    poses: int = 100
    exact_m: float = 1e-6
    linearisations: int = 4  # from one linearisation to the next the error along a curve is squared


@dataclass(frozen=True, eq=False)
class ChainFigures:
    """Figures (9 + d,): camera xyz [m], rpy [rad] and marker xyz [m] in their links, joint offsets [rad, m]."""

    robot: RobotDescription  # the nominal model
    # posteriors of its chain, or of that chain placed elsewhere, the most probable first; all have the same chain
    beliefs: tuple[ChainBelief, ...]
    shares: FloatArray  # their probabilities (m,), which add up to 1
    prior: ChainBelief  # prior of that chain before any pair

    @property
    def geometry(self) -> CalibratedGeometry:
        return self._geometry(self.beliefs[0].mean, self._split(self.beliefs[0]))

    @cached_property
    def values(self) -> FloatArray:
        """The figures (9 + d,) of the most probable chain."""
        return self._figures(self._split(self.beliefs[0]))

    @property
    def drawn(self) -> FloatArray:
        """The figures (9 + d,) of robot.toml and URDF."""
        camera, marker = self.robot.camera, self.robot.robot.marker_xyz
        return np.array([*camera.xyz, *rpy_of(camera.pose[:3, :3]), *marker, *np.zeros(len(self.robot.joints))])

    @cached_property
    def covariance(self) -> FloatArray:
        """Covariance (9 + d, 9 + d) of `values`, given that offsets which are not `shown` are right.

        It is that of the mixture of the posteriors, so it includes the uncertainty of the arm's tolerances.
        """
        covariance = np.zeros((len(self.values), len(self.values)))
        for belief, share in zip(self.beliefs, self.shares, strict=True):
            split = self._split(belief)
            steps = _Settings.step * np.eye(len(split))
            figures = self._figures(split)
            jacobian = (
                np.array([_wrap_camera_angles(self._figures(moved) - figures) for moved in split + steps]).T
                / _Settings.step
            )
            offset = _wrap_camera_angles(self._figures(split) - self.values)
            conditioned = _conditioned(belief.covariance, self._unidentified)
            covariance += share * (jacobian @ conditioned @ jacobian.T + np.outer(offset, offset))
        return covariance

    def hand_eye(self, frame: str) -> HandEye:
        """Return the camera's pose, in SI with its covariance; `frame` is the ROS name of the measurement frame."""
        covariance = pose_covariance(lambda v: pose_of(v[:3], v[3:]), self.values[:6], self.covariance[:6, :6])
        return HandEye.of(self.robot.camera.parent_link, frame, self.geometry.T_parent_camera, covariance)

    @property
    def half_widths(self) -> FloatArray:
        """Half the 95 % intervals (9 + d,) of `values`."""
        variances = np.diagonal(self.covariance)
        return HALF_WIDTH_95 * np.sqrt(np.maximum(variances, 0.0))  # a given offset keeps some rounding

    @cached_property
    def shown(self) -> BoolArray:
        """Mask (d,) of identifiable joint offsets; others may be equivalent to a rotation of the camera or the marker.

        An offset that exact pairs of all poses would not determine counts as not identifiable: along such directions a
        posterior that was linearised at several places seems more certain than it is.
        """
        zeros = self._zeros
        return (_spread(self.beliefs[0], zeros) < self._unidentified_std) & (
            _spread(self._exactly_informed, zeros) < self._unidentified_std
        )

    @property
    def moved(self) -> FloatArray:
        """`values` minus `drawn` (9 + d,), angles the shorter way round."""
        return _wrap_camera_angles(self.values - self.drawn)

    @property
    def _unidentified_std(self) -> FloatArray:
        return _Settings.min_unidentified_share * _spread(self.prior, self._zeros)

    @cached_property
    def _exactly_informed(self) -> ChainBelief:
        return posterior_of_exact_pairs(self.prior, self.beliefs[0].mean, self.robot)

    def _split(self, belief: ChainBelief) -> FloatArray:
        """Return the most probable change (size,) with the joint offsets that are not identifiable kept at nominal."""
        unidentified = self._unidentified
        covariance = belief.covariance
        gain = np.linalg.solve(covariance[np.ix_(unidentified, unidentified)], covariance[unidentified])
        split = belief.mean - belief.mean[unidentified] @ gain
        split[unidentified] = 0.0
        return split

    @property
    def _unidentified(self) -> IntArray:
        """Indices of the joint offsets that are not identifiable, without those that are fixed at nominal."""
        return self._zeros[~self.shown & (_spread(self.prior, self._zeros) > 0.0)]

    @property
    def _zeros(self) -> IntArray:
        return np.arange(self._parameters.size)[self._parameters.zeros]

    @property
    def _parameters(self) -> ChainParameters:
        return self.beliefs[0].parameters

    def _geometry(self, change: FloatArray, split: FloatArray) -> CalibratedGeometry:
        """Return the geometry of `change`, with the camera move and joint offsets of the nearly equivalent `split`."""
        parameters = self._parameters
        T_placed_nominal = parameters.reference.fixed[0] @ inverse(self.robot.chain.fixed[0])
        return CalibratedGeometry.of(
            self.robot,
            parameters.chain(change),
            T_measured_nominal=parameters.base_pose(split) @ T_placed_nominal,
            zeros=split[parameters.zeros],
        )

    def _figures(self, split: FloatArray) -> FloatArray:
        """Return the figures (9 + d,) of a change, links included; else an unidentifiable offset moves the marker."""
        geometry = self._geometry(split, split)
        camera = geometry.T_parent_camera
        return np.concatenate([camera[:3, 3], rpy_of(camera[:3, :3]), geometry.marker_xyz, split[self._zeros]])


def posterior_of_exact_pairs(prior: ChainBelief, change: FloatArray, robot: RobotDescription) -> ChainBelief:
    """Return the posterior after exact pairs of all poses, linearised at a change (size,)."""
    _, jacobian = prior.parameters.linearised(change, _poses(robot))
    rows = (jacobian @ prior.root).reshape(-1, prior.root.shape[1]) / _Settings.exact_m
    _, singular, vt = np.linalg.svd(rows, full_matrices=False)
    return replace(prior, root=prior.root @ (vt.T / np.sqrt(1.0 + np.square(singular))))


def most_probable_equivalent(prior: ChainBelief, change: FloatArray, robot: RobotDescription) -> FloatArray:
    """Return the change (size,) most probable under the prior among all that give the same positions as `change`.

    These changes lie along a curve, so several linearisations are needed.
    """
    poses = _poses(robot)
    positions, found = prior.parameters.positions(change, poses), change
    for _ in range(_Settings.linearisations):
        x, jacobian = prior.parameters.linearised(found, poses)
        u, singular, vt = np.linalg.svd(
            (jacobian @ prior.root).reshape(3 * _Settings.poses, -1) / _Settings.exact_m, full_matrices=False
        )
        target = (positions - x + jacobian @ (found - prior.mean)).ravel() / _Settings.exact_m
        found = prior.mean + prior.root @ (vt.T @ (singular / (1.0 + np.square(singular)) * (u.T @ target)))
    return found


def limited_to_exact_pairs(belief: ChainBelief, prior: ChainBelief, robot: RobotDescription) -> ChainBelief:
    """Return a posterior made in several linearisations, with the prior restored where pairs are uninformative.

    Chains that give the same positions lie along a curve, and its tangents differ from place to place. Pairs that were
    linearised at one place therefore seem informative about the tangents at another (Huang, Mourikis and Roumeliotis
    2010, on the consistency of the extended Kalman filter). In no direction is the returned posterior more certain than
    exact pairs would make it. Along directions that pairs do not determine, its mean moves to the maximum of the prior.
    """
    change = most_probable_equivalent(prior, belief.mean, robot)
    best = posterior_of_exact_pairs(prior, change, robot)
    free = np.flatnonzero(prior.root.any(axis=1))
    std = _spread(prior, free)
    own_covariance, least_covariance = (
        scaled @ scaled.T for scaled in (each.root[free] / std[:, None] for each in (belief, best))
    )
    factor = np.linalg.cholesky(own_covariance + least_covariance)
    half = np.linalg.solve(factor, np.linalg.solve(factor, least_covariance).T)
    shares, vectors = np.linalg.eigh((half + half.T) / 2.0)
    root = np.zeros((len(belief.mean), len(free)))
    root[free] = std[:, None] * (factor @ vectors) * np.sqrt(np.maximum(shares, 1.0 - shares))
    return replace(belief, mean=change, root=root)


def _poses(robot: RobotDescription) -> FloatArray:
    """Return a fixed random sample of configurations (m, d) within the joint limits."""
    return np.random.default_rng(0).uniform(robot.lower, robot.upper, (_Settings.poses, len(robot.joints)))


def tolerances_determined(tolerances: Sequence[tuple[float, float]]) -> bool:
    """Return True if the probable tolerances (axes [rad], positions [m]) agree within the factor `max_ratio`."""
    axes = [axes for axes, _ in tolerances]
    return max(axes) <= _Settings.max_ratio * min(axes)


def _spread(belief: ChainBelief, which: IntArray) -> FloatArray:
    """Return 1-sigma (k,) of some of the parameters."""
    return np.sqrt(np.square(belief.root[which]).sum(axis=1))


def _conditioned(covariance: FloatArray, known: IntArray) -> FloatArray:
    """Return the covariance (m, m) of a Gaussian conditioned on some of its components."""
    across = covariance[:, known]
    return covariance - across @ np.linalg.solve(covariance[np.ix_(known, known)], across.T)


def _wrap_camera_angles(difference: FloatArray) -> FloatArray:
    """Wrap the camera angles of a difference of figures (9 + d,) to [-π, π), in place, and return it."""
    difference[3:6] = np.remainder(difference[3:6] + np.pi, 2.0 * np.pi) - np.pi
    return difference
