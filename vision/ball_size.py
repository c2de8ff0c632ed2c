"""How large the ball is, learnt while it is followed, and what a size that does not fit says of a fix.

What pulls a centre, fingertips over the limb or an edge of the ball's hue along it, makes the ball seem smaller or
larger by as much, and may do so in both eyes alike. Then neither the rows nor the two sizes contradict each other; but
the size contradicts the one that the ball had a moment ago.
"""

from __future__ import annotations

from collections import deque
from dataclasses import replace

import numpy as np

from bodyschema.interfaces.camera import StereoCalibration
from bodyschema.interfaces.records import FloatArray, Reason

from .triangulate import Location, triangulate

# How well somebody measures a ball (1-sigma, relative), and what calibration leaves of a size at one place and another.
RADIUS_SIGMA, _TOLERANCE = 0.03, 0.004
# So many fixes are remembered.
_MEMORY = 31
# A size that is off by no more sigmas than this says nothing.
_FREE_SIGMAS = 1.5
# Where the size of so many fixes is known, what is off by more than these is something else: sigmas, and relative.
_FEWEST, _MOST_SIGMAS, _MOST_OFF = 5, 4.0, 0.06


class BallSize:
    """The ball's radius as a share of the configured one."""

    def __init__(self, calibration: StereoCalibration) -> None:
        """Nothing is known yet but the configured radius."""
        self._calibration = calibration
        self._shares: deque[tuple[float, float]] = deque(maxlen=_MEMORY)

    def forget(self) -> None:
        """Know no more than at first."""
        self._shares.clear()

    def contradicts(self, found: Location) -> Reason | None:
        """SIZE_MISMATCH where something of another size than the ball of the last fixes was found."""
        if len(self._shares) < _FEWEST:
            return None
        off, sigma = self._off(found)
        is_other = (np.abs(off) > np.maximum(_MOST_SIGMAS * sigma, _MOST_OFF)).all()
        return Reason.SIZE_MISMATCH if is_other else None

    def doubted(self, found: Location) -> Location:
        """`found` with each centre as unsure as its size is off, beyond what noise explains."""
        off, sigma = self._off(found)
        # [px²], in both directions: nothing tells from where the centre is pulled.
        excess = np.maximum(0.0, off**2 - (_FREE_SIGMAS * sigma) ** 2) * found.radii_px**2
        if not excess.any():
            return found
        pulled = triangulate(self._calibration, found.centres_px, np.repeat(np.maximum(excess, 1e-12), 2))
        return found if pulled is None else replace(found, cov=found.cov + pulled[1])

    def learn(self, found: Location) -> None:
        """Take the size of a fix into account."""
        self._shares.append((float(found.sizes.mean()), float(np.sqrt(_variances(found).mean()))))

    def _off(self, found: Location) -> tuple[FloatArray, FloatArray]:
        """By how much each eye's size is off, relative, shape (2,), and the 1-sigma of that."""
        share, share_sigma = self._known()
        return found.sizes / share - 1.0, np.sqrt(_variances(found) + share_sigma**2)

    def _known(self) -> tuple[float, float]:
        """The share and its 1-sigma."""
        if not self._shares:
            return 1.0, RADIUS_SIGMA
        shares, sigmas = np.array(self._shares).T
        # The median, as some of the fixes may have been pulled themselves.
        order = np.argsort(shares)
        weights = sigmas[order] ** -2
        median = shares[order][np.searchsorted(np.cumsum(weights), 0.5 * weights.sum())]
        sum_of_weights = RADIUS_SIGMA**-2 + weights.sum()
        return float(RADIUS_SIGMA**-2 + weights.sum() * median) / sum_of_weights, sum_of_weights**-0.5


def _variances(found: Location) -> FloatArray:
    """Of each eye's size by itself, shape (2,): what its radius and its depth leave unsure."""
    return found.size_sigmas**2 + found.cov[2, 2] / found.x[2] ** 2 + _TOLERANCE**2
