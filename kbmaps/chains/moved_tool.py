"""A learnt map after its marker was moved to another place on the last link, or the tool was changed."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from kbmaps.arrays import FloatArray
from kbmaps.chains.chain import RigidChain
from kbmaps.errors import DegenerateDataError
from kbmaps.maps.kbmap import POSITION_OUTPUTS, KBMap
from kbmaps.pairs import checked_pairs
from kbmaps.robust import MEDIAN_NORM, ROUNDING_M, UNCALIBRATED_SIGMAS


def with_refitted_tool(
    kbmap: KBMap, chain: RigidChain, q: ArrayLike, x: ArrayLike, sigma: float | None = None
) -> KBMap:
    """Return the map after its marker was moved to another place on the last link, or the tool was changed.

    The offset δ is fitted, robustly, to pairs seen since: x ≈ f(q) + R(q) δ with the orientation R of the nominal
    chain. With E the nets of R it is built in exactly, G ← G + E δ. Errors of R itself are left to a learner.

    Args:
        kbmap: the map as learnt before the change; of its outputs only the position moves.
        chain: the nominal chain, which supplies the orientations.
        q, x: pairs since the change, (n, d) [rad, m] and (n, 3) [m].
        sigma: noise of one coordinate [m], if known.

    Raises:
        ShapeError, NonFiniteError, SettingError (a sigma that is not positive), DegenerateDataError (no pairs)
    """
    angles, positions, _ = checked_pairs(q, x, sigma, chain.joints)
    if not len(angles):
        raise DegenerateDataError("a marker's move needs at least 1 pair seen since; record more")
    oriented = KBMap(kbmap.bases, np.concatenate([kbmap.net[:POSITION_OUTPUTS], chain.orientation_maps(kbmap.bases)]))
    errors = positions - oriented.predict(angles)
    # R is a rotation: its transpose takes each pair's error to an estimate of δ, with the same noise.
    offsets = (chain.orientation(angles).swapaxes(1, 2) @ errors[..., None])[..., 0]
    net = kbmap.net.copy()
    net[:POSITION_OUTPUTS] = oriented.with_tool(_robust_mean(offsets, sigma or 0.0)).net[:POSITION_OUTPUTS]
    return KBMap(kbmap.bases, net, kbmap.metadata)


def _robust_mean(offsets: FloatArray, sigma: float) -> FloatArray:
    """Return the mean (3,) of offsets (n, 3) without outliers.

    It starts from their median, so that up to half of them may be arbitrary. Fewer than five have no majority, and all
    count.
    """
    centre = np.median(offsets, axis=0)
    for _ in range(len(offsets)):
        distances = np.linalg.norm(offsets - centre, axis=1)
        mean = offsets[distances <= ROUNDING_M + UNCALIBRATED_SIGMAS * max(_spread(distances), sigma)].mean(axis=0)
        if (mean == centre).all():
            break
        centre = mean
    return centre


def _spread(distances: FloatArray) -> float:
    """Return the standard deviation of a coordinate from the middle distance.

    Its rank lies above the median by the one pair that an offset can always explain (Rousseeuw and Leroy 1987, least
    median of squares). Otherwise a few pairs would fit perfectly and the others would count as outliers.
    """
    rank = min(len(distances) // 2 + 1, len(distances) - 1)
    return float(np.partition(distances, rank)[rank]) / MEDIAN_NORM
