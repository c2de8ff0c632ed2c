"""A marker that was moved on the hand: three numbers instead of a whole net."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from kbmaps.align import align
from kbmaps.arrays import rows
from kbmaps.chain import RigidChain
from kbmaps.kbmap import POSITION_OUTPUTS, KBMap


def with_refitted_marker(
    kbmap: KBMap, chain: RigidChain, q: ArrayLike, x: ArrayLike, sigma: float | None = None
) -> KBMap:
    """The map after its marker was moved to another place on the last link, or the tool was changed.

    The move δ is fitted, robustly, to pairs seen since: x ≈ f(q) + R(q) δ with the orientation R of the nominal
    chain. With E the nets of R it is built in exactly, G ← G + E δ. What R's own errors leave is for a learner.

    Args:
        kbmap: the map as learnt before the change; of its outputs only the position moves.
        chain: the nominal chain, whose orientations are used.
        q, x: pairs since the change, (n, d) [rad, m] and (n, 3) [m].
        sigma: noise of one coordinate [m], if known.

    Raises:
        ShapeError, NonFiniteError, SettingError, DegenerateDataError (no pairs)
    """
    angles, positions = rows("q", q, chain.joints), rows("x", x, POSITION_OUTPUTS)
    # The marker's move explains what the map gets wrong, so let it be seen from the nominal chain alone.
    seen = positions - kbmap.predict(angles) + chain.positions(angles)
    shift = align(chain, angles, seen, pose_known=True, marker_known=False, sigma=sigma).marker_shift
    axes = chain.orientation_maps(kbmap.bases).reshape(3, POSITION_OUTPUTS, *kbmap.net.shape[1:])
    net = kbmap.net.copy()
    net[:POSITION_OUTPUTS] += np.einsum("a,a...->...", shift, axes)
    return KBMap(kbmap.bases, net, kbmap.metadata)
