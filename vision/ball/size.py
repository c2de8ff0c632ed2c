"""Track the apparent size of the ball and use it to check each fix.

Fingertips over the outline, or a nearby edge of the ball's hue, shift a measured centre and make the ball seem
smaller or larger by the same amount. If both eyes are affected equally, neither the rows nor the two sizes contradict
each other. But the size then contradicts that of the previous fixes.
"""

from __future__ import annotations

from collections import deque
from dataclasses import replace

import numpy as np

from bodyschema.interfaces.camera import StereoCalibration
from bodyschema.interfaces.records import FloatArray, Reason
from bodyschema.vision.triangulate import Location, triangulate

from .settings import TrackSettings as _Settings


class BallSize:
    """The ball's radius as a fraction of the configured one."""

    def __init__(self, calibration: StereoCalibration) -> None:
        self._calibration = calibration
        self._shares: deque[tuple[float, float]] = deque(maxlen=_Settings.memory)
        self._known = self._estimated()

    def forget(self) -> None:
        """Forget the learned radius."""
        self._shares.clear()
        self._known = self._estimated()

    def contradicts(self, found: Location) -> Reason | None:
        """Return SIZE_MISMATCH if the size differs too much from that of the previous fixes."""
        if len(self._shares) < _Settings.fewest:
            return None
        error, sigma = self._size_error(found)
        is_other = (np.abs(error) > np.maximum(_Settings.max_sigmas * sigma, _Settings.max_size_error)).all()
        return Reason.SIZE_MISMATCH if is_other else None

    def with_size_error(self, found: Location) -> Location:
        """Return `found` with each centre's covariance increased by its size error beyond noise."""
        error, sigma = self._size_error(found)
        # [px²], in both directions: the direction of the shift is unknown.
        excess = np.maximum(0.0, error**2 - (_Settings.free_sigmas * sigma) ** 2) * found.radii_px**2
        if not excess.any():
            return found
        shifted = triangulate(self._calibration, found.centres_px, np.repeat(np.maximum(excess, 1e-12), 2))
        return found if shifted is None else replace(found, cov=found.cov + shifted[1])

    def learn(self, found: Location) -> None:
        """Update the radius with the size of a fix."""
        self._shares.append((float(found.sizes.mean()), float(np.sqrt(_variances(found).mean()))))
        self._known = self._estimated()

    def _size_error(self, found: Location) -> tuple[FloatArray, FloatArray]:
        """Return each eye's relative size error, shape (2,), and its 1-sigma."""
        share, share_sigma = self._known
        return found.sizes / share - 1.0, np.sqrt(_variances(found) + share_sigma**2)

    def _estimated(self) -> tuple[float, float]:
        """Return the estimated share and its 1-sigma."""
        if not self._shares:
            return 1.0, _Settings.radius_sigma
        shares, sigmas = np.array(self._shares).T
        # The median is robust to fixes whose centre was shifted.
        order = np.argsort(shares)
        weights = sigmas[order] ** -2
        median = shares[order][np.searchsorted(np.cumsum(weights), 0.5 * weights.sum())]
        sum_of_weights = _Settings.radius_sigma**-2 + weights.sum()
        return float(_Settings.radius_sigma**-2 + weights.sum() * median) / sum_of_weights, sum_of_weights**-0.5


def _variances(found: Location) -> FloatArray:
    """Return the variance of each eye's size, shape (2,), from its radius and its depth."""
    return found.size_sigmas**2 + found.cov[2, 2] / found.x[2] ** 2 + _Settings.place_tolerance**2
