"""What is believed of a chain, in the numbers that have names: pose of the camera, place of the marker, joint zeros."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from interfaces.calibrated import CalibratedGeometry
from interfaces.records import FloatArray
from interfaces.robot import RobotDescription
from interfaces.rpy import rpy_of
from interfaces.urdf import inverse
from kbmaps import ChainBelief, ChainParameters

BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.intp]

# How well arms are made: tilt of an axis [rad] and its shift [m], 1-sigma, from a milled arm to a kit. Which of them
# an arm is, its pairs tell.
WORKMANSHIP = ((0.0003, 0.0001), (0.001, 0.0005), (0.003, 0.001), (0.01, 0.003), (0.03, 0.01), (0.06, 0.03))
# Workmanship that is less probable than this is not considered.
LEAST_SHARE = 0.01
HALF_WIDTH_95 = 1.959964
# A zero that is still as uncertain as it was before is nothing that the pairs show.
NOT_SHOWN = 0.9
# Of the numerical derivatives by tilts, shifts and zeros [rad, m].
_STEP = 1e-6


@dataclass(frozen=True, eq=False)
class ChainFigures:
    """Camera xyz [m] and rpy [rad] in its link, marker xyz [m] in its own, joint zeros [rad, m]: (9 + d,) figures.

    Attributes:
        robot: the nominal model.
        beliefs: in its chain, or in that chain placed elsewhere; the most probable first. They change one chain.
        shares: how probable each is (m,); they add up to 1.
        zeros_std: how far each joint's zero may be off before any pair (d,), 1-sigma [rad, m].
    """

    robot: RobotDescription
    beliefs: tuple[ChainBelief, ...]
    shares: FloatArray
    zeros_std: FloatArray

    @property
    def geometry(self) -> CalibratedGeometry:
        """The most probable chain in the terms of the robot's files."""
        return self._geometry(self.beliefs[0].mean)

    @cached_property
    def values(self) -> FloatArray:
        """The figures (9 + d,) of the most probable chain."""
        return self._figures(self.beliefs[0].mean)

    @property
    def drawn(self) -> FloatArray:
        """The figures (9 + d,) of robot.toml and URDF."""
        camera, marker = self.robot.camera, self.robot.robot.marker_xyz
        return np.array([*camera.xyz, *rpy_of(camera.pose[:3, :3]), *marker, *np.zeros(len(self.robot.joints))])

    @cached_property
    def half_widths(self) -> FloatArray:
        """Half the 95 % intervals (9 + d,) of `values`, given that zeros which are not `shown` are right.

        Not knowing how well the arm is made is part of them: they are of the mixture of the beliefs.
        """
        variance = np.zeros(len(self.values))
        for belief, share in zip(self.beliefs, self.shares, strict=True):
            jacobian = self._derivatives(belief.mean)
            covariance = _given(belief.covariance, self._zeros[~self.shown])
            apart = _unwound(self._figures(belief.mean) - self.values)
            variance += share * (np.einsum("ij,jk,ik->i", jacobian, covariance, jacobian) + np.square(apart))
        return HALF_WIDTH_95 * np.sqrt(np.maximum(variance, 0.0))  # of a zero that is given, rounding is left

    @cached_property
    def shown(self) -> BoolArray:
        """Which joints' zeros (d,) the pairs show; a turn of the camera or of the marker may do what others do."""
        left = np.sqrt(np.square(self.beliefs[0].root[self._zeros]).sum(axis=1))
        return left < NOT_SHOWN * self.zeros_std

    @property
    def moved(self) -> FloatArray:
        """`values` less `drawn` (9 + d,), angles the shorter way round."""
        return _unwound(self.values - self.drawn)

    @property
    def _zeros(self) -> IntArray:
        return np.arange(self._parameters.size)[self._parameters.zeros]

    @property
    def _parameters(self) -> ChainParameters:
        return self.beliefs[0].parameters

    def _geometry(self, change: FloatArray) -> CalibratedGeometry:
        parameters = self._parameters
        T_placed_nominal = parameters.reference.fixed[0] @ inverse(self.robot.chain.fixed[0])
        return CalibratedGeometry.of(
            self.robot,
            parameters.chain(change),
            T_measured_nominal=parameters.base_pose(change) @ T_placed_nominal,
            zeros=change[parameters.zeros],
        )

    def _figures(self, change: FloatArray) -> FloatArray:
        geometry = self._geometry(change)
        camera = geometry.T_parent_camera
        return np.concatenate([camera[:3, 3], rpy_of(camera[:3, :3]), geometry.marker_xyz, change[self._zeros]])

    def _derivatives(self, change: FloatArray) -> FloatArray:
        steps = _STEP * np.eye(len(change))
        here = self._figures(change)
        return np.array([_unwound(self._figures(change + step) - here) for step in steps]).T / _STEP


def probable(evidence: FloatArray) -> tuple[IntArray, FloatArray]:
    """Which of several explanations are probable at all, the most probable first, and their shares.

    Args:
        evidence: log marginal likelihood of each (m,) (MacKay 1992, "Bayesian interpolation").
    """
    shares = np.exp(evidence - evidence.max())
    shares /= shares.sum()
    kept = np.array([k for k in np.argsort(-shares) if shares[k] > LEAST_SHARE], dtype=np.intp)
    return kept, shares[kept] / shares[kept].sum()


def _given(covariance: FloatArray, known: IntArray) -> FloatArray:
    """The covariance (m, m) of a Gaussian once some of its components are known."""
    across = covariance[:, known]
    return covariance - across @ np.linalg.solve(covariance[np.ix_(known, known)], across.T)


def _unwound(difference: FloatArray) -> FloatArray:
    """A difference of figures (9 + d,) whose camera angles go the shorter way round."""
    difference[3:6] = np.remainder(difference[3:6] + np.pi, 2.0 * np.pi) - np.pi
    return difference
