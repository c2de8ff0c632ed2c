"""What was measured, and how exactly: positions with the shape of their noise."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from bodyschema.effects import Motion, Simulation
from bodyschema.interfaces.camera import StereoCalibration
from bodyschema.interfaces.recording import Recording
from bodyschema.interfaces.records import FloatArray

IntArray = NDArray[np.intp]

# Where nothing is said of the noise it is taken as round; its size is estimated in any case [m].
_UNIT_M = 1e-3
# How far outliers may lie: this times the spread of what was measured.
_OUTLIER_SPREAD = 2.0
# A measured variance is never taken to be smaller than this share of the median one.
_SMALLEST_VARIANCE = 1e-4
# Runs shorter than this are single poses, not ways.
_ROWS_A_RUN = 10
# Readings nearer than this are one; so many different ones it takes to see a step, so far they may be off it.
_SAME_READING, _FEWEST_GAPS, _OFF_A_MULTIPLE = 1e-9, 20, 0.02


@dataclass(frozen=True, eq=False)
class Observations:
    """Measured positions over a motion.

    Attributes:
        motion: what the encoders read.
        x: measured positions (n, 3) [m].
        stated: covariance (n, 3, 3) [m²] of the instrument, right but for one factor.
        rounding: covariance (n, 3, 3) [m²] that comes from readings in whole ticks.
        stated_factor: by how much the instrument's standard deviations are larger than stated.
        doubtful: rows (n,) at which something is not known that the simulation would need; None for none.
    """

    motion: Motion
    x: FloatArray
    stated: FloatArray
    rounding: FloatArray
    stated_factor: float = 1.0
    doubtful: NDArray[np.bool_] | None = None

    @classmethod
    def of(cls, recording: Recording, simulation: Simulation) -> Observations:
        """The positions of a recording; the instrument's noise is its own, else the stereo camera's, else round."""
        calibration = simulation.robot.calibration
        if recording.cov is not None:
            stated = _bounded(recording.cov)
        elif calibration is not None and calibration.is_stereo:
            stated = _bounded(stereo_covariances(recording.x, calibration))
        else:
            stated = np.broadcast_to(_UNIT_M**2 * np.eye(3), (len(recording), 3, 3))
        motion = Motion.of(recording)
        moved = simulation.run(motion).by_joint * (ticks(recording.q) / np.sqrt(12.0))
        return cls(motion, recording.x, stated, moved @ np.swapaxes(moved, 1, 2))

    @cached_property
    def whitening(self) -> FloatArray:
        """(n, 3, 3): W (x - truth) has equal and independent noise in all coordinates, but for one factor."""
        covariances = self.stated_factor**2 * self.stated + self.rounding
        return np.asarray(np.linalg.inv(np.linalg.cholesky(covariances)), dtype=np.float64)

    def without(self, doubtful: NDArray[np.bool_]) -> Observations:
        """The same with rows (n,) that count nothing."""
        return replace(self, doubtful=doubtful)

    def with_factor(self, stated_factor: float) -> Observations:
        """The same with another size of the instrument's noise beside that of the rounding."""
        return replace(self, stated_factor=stated_factor)

    def __len__(self) -> int:
        return len(self.x)

    def whitened(self, columns: FloatArray) -> FloatArray:
        """Columns (n, 3, p) [m] in units of the noise."""
        return self.whitening @ columns

    def residuals(self, predicted: FloatArray) -> FloatArray:
        """Measured minus predicted (n, 3), in units of the noise."""
        return np.einsum("nij,nj->ni", self.whitening, self.x - predicted)

    @cached_property
    def trusted(self) -> NDArray[np.bool_]:
        """Rows (n,) of which the way there was seen: where a run begins, what has a memory is not known."""
        begins = self.motion.begins
        if begins.sum() * _ROWS_A_RUN > len(self):
            begins = np.zeros(len(self), dtype=np.bool_)
        return ~begins if self.doubtful is None else ~(begins | self.doubtful)

    @cached_property
    def outlier_density(self) -> FloatArray:
        """Logarithm of the density (n,) of a fix that is not the marker, per unit volume of whitened space."""
        spread = _OUTLIER_SPREAD * np.linalg.norm(self.x - np.median(self.x, axis=0), axis=1).max()
        volume = 4.0 / 3.0 * np.pi * max(float(spread), _UNIT_M) ** 3
        return -np.log(volume) - np.linalg.slogdet(self.whitening)[1]


def ticks(q: FloatArray) -> FloatArray:
    """The step (d,) [rad, m] in which each joint is read; 0 where its readings (n, d) are no multiples of any."""
    steps = np.zeros(q.shape[1])
    for k, column in enumerate(q.T):
        gaps: FloatArray = np.diff(np.unique(column))
        gaps = gaps[gaps > _SAME_READING]
        if len(gaps) < _FEWEST_GAPS:
            continue
        multiples = gaps / gaps.min()
        if np.abs(multiples - np.round(multiples)).max() < _OFF_A_MULTIPLE:
            steps[k] = gaps.min()
    return steps


def stereo_covariances(x: FloatArray, calibration: StereoCalibration) -> FloatArray:
    """Covariance (n, 3, 3) [m²] of triangulated points (n, 3) whose image coordinates are `pixel_sigma` uncertain."""
    f, b = calibration.focal_px, calibration.baseline_m
    depth = np.maximum(np.abs(x[:, 2]), 1e-3)
    by_left, by_right, by_row = np.zeros((3, len(x), 3))
    # z = f b / (ul - ur), x = (ul - cx) z / f, y = (v - cy) z / f with v the mean of both rows
    by_left[:, 2] = -(depth**2) / (f * b)
    by_right[:, 2] = -by_left[:, 2]
    for change in (by_left, by_right):
        change[:, 0] = x[:, 0] / depth * change[:, 2]
        change[:, 1] = x[:, 1] / depth * change[:, 2]
    by_left[:, 0] += depth / f
    by_row[:, 1] = np.sqrt(0.5) * depth / f
    covariance = sum(np.einsum("ni,nj->nij", change, change) for change in (by_left, by_right, by_row))
    return calibration.pixel_sigma**2 * np.asarray(covariance)


def _bounded(covariances: FloatArray) -> FloatArray:
    """With a floor under each variance, so that no row counts for all."""
    floor = _SMALLEST_VARIANCE * float(np.median(np.trace(covariances, axis1=1, axis2=2))) / 3.0
    return covariances + (floor if floor > 0.0 else _UNIT_M**2) * np.eye(3)
