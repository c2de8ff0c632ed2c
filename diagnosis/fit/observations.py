"""Hold measured positions with the covariance of their noise."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from bodyschema.effects import Motion, Simulation
from bodyschema.interfaces.camera import StereoCalibration
from bodyschema.interfaces.records import FloatArray
from bodyschema.recordings.recording import Recording

IntArray = NDArray[np.intp]


class _Settings:
    unit_m = 1e-3  # isotropic noise for recordings that state none; its size is estimated in any case [m]
    outlier_spread = 2.0  # outliers lie within this multiple of the spread of the measured positions
    smallest_variance = 1e-4  # floor of a measured variance, as a share of the median one
    rows_a_run = 10  # shorter runs are single poses, not paths
    # Closer readings are equal; minimum of distinct gaps to find a step; tolerance around its multiples.
    same_reading, min_gaps, off_a_multiple = 1e-9, 20, 0.02


@dataclass(frozen=True, eq=False)
class Observations:
    """Measured positions over a motion."""

    motion: Motion  # the encoder readings
    x: FloatArray  # measured positions (n, 3) [m]
    stated: FloatArray  # covariance (n, 3, 3) [m²] of the instrument, known up to one factor
    rounding: FloatArray  # covariance (n, 3, 3) [m²] from encoder quantisation
    stated_factor: float = 1.0  # factor of the instrument's standard deviations over the stated ones
    # rows (n,) at which the simulation lacks a state it needs; None for no such rows
    ignored: NDArray[np.bool_] | None = None
    play_covariance: FloatArray | None = None  # covariance (n, 3, 3) [m²] of a loose marker; None for one that is fixed
    play: FloatArray | float = 0.0  # displacement (n, 3) [m] of a loose marker that was taken out of `x`; 0 for none
    ignores_history: bool = False  # True if no row is ignored, since each is predicted by its own readings alone

    @classmethod
    def of(cls, recording: Recording, simulation: Simulation) -> Observations:
        """Read the positions of a recording; noise is the recording's, else the stereo camera's, else isotropic."""
        calibration = simulation.robot.calibration
        if recording.cov is not None:
            stated = _bounded(recording.cov)
        elif calibration is not None and calibration.is_stereo:
            stated = _bounded(stereo_covariances(recording.x, calibration))
        else:
            stated = np.broadcast_to(_Settings.unit_m**2 * np.eye(3), (len(recording), 3, 3))
        motion = Motion.of(recording)
        moved = simulation.run(motion).by_joint * (encoder_steps(recording.q) / np.sqrt(12.0))
        return cls(motion, recording.x, stated, moved @ np.swapaxes(moved, 1, 2))

    @cached_property
    def whitening(self) -> FloatArray:
        """W (n, 3, 3) such that W (x - truth) has equal and independent noise in all coordinates, up to one factor."""
        covariances = (
            self.noise_covariances if self.play_covariance is None else self.noise_covariances + self.play_covariance
        )
        return np.asarray(np.linalg.inv(np.linalg.cholesky(covariances)), dtype=np.float64)

    @property
    def noise_covariances(self) -> FloatArray:
        """Covariances (n, 3, 3) [m²] of the instrument and of the encoders' quantisation, up to one factor."""
        return self.stated_factor**2 * self.stated + self.rounding

    def with_loose_marker(self, ratio: FloatArray | float, directions: FloatArray) -> Observations:
        """Return the same observations of a loose marker.

        Args:
            ratio: additional variance by its play relative to the noise, of all rows or of each (n,).
            directions: direction of the play at each row (n, 3).
        """
        variances = ratio * np.trace(self.noise_covariances, axis1=1, axis2=2) / 3.0
        return replace(self, play_covariance=variances[:, None, None] * directions[:, :, None] * directions[:, None, :])

    def without_marker_play(self, play: FloatArray) -> Observations:
        """Return the same observations with the displacement `play` (n, 3) [m] of the marker subtracted."""
        return replace(self, x=self.x + self.play - play, play=play)

    def some(self, rows: IntArray) -> Observations:
        """Return a part of the observations, at increasing rows (m,), before anything is known about the noise."""
        return Observations(self.motion.some(rows), self.x[rows], self.stated[rows], self.rounding[rows])

    def ignoring(self, ignored: NDArray[np.bool_]) -> Observations:
        """Return the same observations, ignoring some rows (n,)."""
        return replace(self, ignored=ignored)

    @property
    def without_history(self) -> Observations:
        """The same observations for an arm without memory: all rows count, on both sides of a play."""
        return replace(self, ignored=None, play_covariance=None, ignores_history=True)

    def with_factor(self, stated_factor: float) -> Observations:
        """Return the same observations with another factor on the instrument's noise."""
        return replace(self, stated_factor=stated_factor)

    def __len__(self) -> int:
        return len(self.x)

    def whitened(self, columns: FloatArray) -> FloatArray:
        """Return columns (n, 3, p) [m] in units of the noise."""
        return self.whitening @ columns

    def residuals(self, predicted: FloatArray) -> FloatArray:
        """Return measured minus predicted (n, 3), in units of the noise."""
        return np.einsum("nij,nj->ni", self.whitening, self.x - predicted)

    @cached_property
    def trusted(self) -> NDArray[np.bool_]:
        """Rows (n,) whose preceding path was observed; at a run's start the state of joints with memory is unknown."""
        begins = self.motion.begins
        if self.ignores_history or begins.sum() * _Settings.rows_a_run > len(self):
            begins = np.zeros(len(self), dtype=np.bool_)
        return ~begins if self.ignored is None else ~(begins | self.ignored)

    @cached_property
    def outlier_density(self) -> FloatArray:
        """Log density (n,) of an outlier, per unit volume of whitened space."""
        spread = _Settings.outlier_spread * np.linalg.norm(self.x - np.median(self.x, axis=0), axis=1).max()
        volume = 4.0 / 3.0 * np.pi * max(float(spread), _Settings.unit_m) ** 3
        return -np.log(volume) - np.linalg.slogdet(self.whitening)[1]


def encoder_steps(q: FloatArray) -> FloatArray:
    """Return the encoder step (d,) [rad, m] of each joint; 0 if readings (n, d) are not multiples of a step."""
    steps = np.zeros(q.shape[1])
    for k, column in enumerate(q.T):
        gaps: FloatArray = np.diff(np.unique(column))
        gaps = gaps[gaps > _Settings.same_reading]
        if len(gaps) < _Settings.min_gaps:
            continue
        multiples = gaps / gaps.min()
        if np.abs(multiples - np.round(multiples)).max() < _Settings.off_a_multiple:
            steps[k] = gaps.min()
    return steps


def stereo_covariances(x: FloatArray, calibration: StereoCalibration) -> FloatArray:
    """Return covariances (n, 3, 3) [m²] of triangulated points (n, 3), whose pixel noise is `pixel_sigma`."""
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
    """Add a floor to each variance, so that no row dominates."""
    floor = _Settings.smallest_variance * float(np.median(np.trace(covariances, axis1=1, axis2=2))) / 3.0
    return covariances + (floor if floor > 0.0 else _Settings.unit_m**2) * np.eye(3)
