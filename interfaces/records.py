"""Define readings, frames, fixes and pairs: frozen, in SI units; arrays are float64 and read-only."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray = NDArray[np.float64]
ImageArray = NDArray[np.uint8]


class PairLimits:
    # A position farther away than this is not one in metres [m].
    farthest_m = 1000.0
    # No joint goes so far: such a number is not an angle in radians, nor a way in metres [rad or m].
    largest_q = 1e6


def frozen_array(values: ArrayLike) -> FloatArray:
    """Return a read-only float64 copy of `values`."""
    array = np.array(values, dtype=np.float64)
    array.setflags(write=False)
    return array


class Reason(StrEnum):
    """Reason why a frame or a fix did not become a pair. The names are the keys of the counters in `status`."""

    NO_MARKER = "no_marker"  # nothing of the marker's colour, or too few pixels
    AT_BORDER = "at_border"  # the marker touches the image border
    OCCLUDED = "occluded"  # something covers a part of it
    NOT_ROUND = "not_round"  # the ball's outline is whole but not an ellipse
    NOT_STRAIGHT = "not_straight"  # a tag's edges scatter or are bent
    MIRRORED = "mirrored"  # the tag is mirrored, in print or in view
    OTHER_FAMILY = "other_family"  # a tag of another dictionary
    LOW_CONTRAST = "low_contrast"  # too little difference from its surroundings
    BLURRED = "blurred"  # too little detail is left
    SATURATED = "saturated"  # too much of it is over-exposed
    REFLECTION = "reflection"  # a dimmer copy of the marker, or one at an impossible place
    EPIPOLAR = "epipolar"  # the two eyes' rows disagree
    SIZE_MISMATCH = "size_mismatch"  # the two eyes' radii, or radius and depth, disagree
    AMBIGUOUS = "ambiguous"  # more than one candidate fits
    REPROJECTION = "reprojection"  # the detection does not fit the marker's shape
    DISAGREEING = "disagreeing"  # several sources contradict each other
    IMPLAUSIBLE_SPEED = "implausible_speed"  # farther from the last fix than a hand can move it
    NO_JOINTS = "no_joints"  # no encoder readings around the frame's time
    STALE = "stale"  # encoder readings around the frame's time too far apart
    MOVING = "moving"  # joints too fast for the uncertainty of the frame's time
    LATE_JOINTS = "late_joints"  # joints too fast for the uncertainty of the times of their readings
    TOO_NEAR = "too_near"  # nearer to the predecessor than the smallest step: wait
    PAUSED = "paused"  # an operator paused the sampler
    NOT_FINITE = "not_finite"  # the tracker gave a position that is not a number
    NOT_STORED = "not_stored"  # the disk did not accept the pair: full, read-only or failing
    NOT_BORNE = "not_borne"  # zero-force should bear the arm, but is off


@dataclass(frozen=True, slots=True)
class JointReading:
    """One reading of all encoders.

    Attributes:
        t: time of the reading on the source's monotonic clock [s].
        q: joint angles [rad] (m for a prismatic joint), shape (d,), in the robot description's order.
        t_sigma: 1-sigma of `t` [s].
    """

    t: float
    q: FloatArray
    t_sigma: float = 0.0


@dataclass(frozen=True, slots=True)
class StereoFrame:
    """Images of one instant, by one or two eyes.

    Attributes:
        t: middle of the exposure on the same clock as the joint readings [s].
        left, right: images, shape (height, width, 3), uint8, in OpenCV's order BGR. Pixel (i, j) (column, row) covers
            the square around (i, j): its centre has the image coordinates u = i, v = j. `right` is None for a single
            camera, whose image is the left one.
        t_sigma: 1-sigma of `t`, and of the time between the exposures of the two eyes [s].
    """

    t: float
    left: ImageArray
    right: ImageArray | None
    t_sigma: float = 0.0

    @property
    def images(self) -> tuple[ImageArray, ...]:
        """One image for each eye, the left one first."""
        return (self.left,) if self.right is None else (self.left, self.right)


@dataclass(frozen=True, slots=True)
class MarkerFix:
    """The measured position of the marker's centre.

    Attributes:
        t: time of the image [s].
        x: position in the measurement frame [m], shape (3,).
        cov: covariance of x [m²], shape (3, 3).
        centres_px: (ul, vl, ur, vr), image of the centre in the left and the right eye; None if the source measures
            positions directly (a laser tracker, a recording) or has only one eye.
        t_sigma: 1-sigma of `t` [s].
        R: orientation of the marker in the measurement frame: a unit quaternion (x, y, z, w), shape (4,); None if the
            marker looks the same from all sides.
        cov_R: covariance of a small rotation about the axes of the measurement frame [rad²], shape (3, 3); None if the
            source does not provide it.
    """

    t: float
    x: FloatArray
    cov: FloatArray
    centres_px: tuple[float, float, float, float] | None = None
    t_sigma: float = 0.0
    R: FloatArray | None = None
    cov_R: FloatArray | None = None


@dataclass(frozen=True, slots=True)
class MarkerMiss:
    """A frame in which the marker was not found, or was doubtful."""

    t: float
    reason: Reason


@dataclass(frozen=True, slots=True)
class Pair:
    """One training experience.

    Attributes:
        store: identity (UUID) of the store that numbered it.
        seq: sequence number in that store, from 1, without gaps.
        segment: number shared by a run of pairs, each one step from its predecessor.
        t: time of the frame on the sampler's monotonic clock [s].
        utc: wall-clock time of the acceptance, ISO 8601.
        q: joint angles interpolated to the frame's time [rad], shape (d,).
        x: marker position in the measurement frame [m], shape (3,).
        cov: covariance of x [m²], shape (3, 3).
        centres_px, R, cov_R: as in `MarkerFix`.
    """

    store: str
    seq: int
    segment: int
    t: float
    utc: str
    q: FloatArray
    x: FloatArray
    cov: FloatArray
    centres_px: tuple[float, float, float, float] | None = None
    R: FloatArray | None = None
    cov_R: FloatArray | None = None
