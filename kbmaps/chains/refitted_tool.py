"""Refit of a marker that was moved on the hand: three numbers instead of a whole net."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from kbmaps.arrays import rows
from kbmaps.chains.chain import RigidChain
from kbmaps.chains.tool_layer import ToolLayer
from kbmaps.errors import DegenerateDataError
from kbmaps.maps.kbmap import POSITION_OUTPUTS, KBMap

# The limit is wide because the errors of an uncalibrated arm have long tails, which must not be rejected.
_OUTLIER_SIGMAS = 15.0


def with_refitted_tool(
    kbmap: KBMap, chain: RigidChain, q: ArrayLike, x: ArrayLike, sigma: float | None = None
) -> KBMap:
    """Return the map after its marker was moved to another place on the last link, or the tool was changed.

    The offset δ is fitted, robustly, to pairs seen since: x ≈ f(q) + R(q) δ with the orientation R of the nominal
    chain (`ToolLayer`). With E the nets of R it is built in exactly, G ← G + E δ. Errors of R itself are left to a
    learner.

    Args:
        kbmap: the map as learnt before the change; of its outputs only the position moves.
        chain: the nominal chain, which supplies the orientations.
        q, x: pairs since the change, (n, d) [rad, m] and (n, 3) [m].
        sigma: noise of one coordinate [m], if known.

    Raises:
        ShapeError, NonFiniteError, SettingError, DegenerateDataError (no pairs)
    """
    angles, positions = rows("q", q, chain.joints), rows("x", x, POSITION_OUTPUTS)
    if not len(angles):
        raise DegenerateDataError("a marker's move needs at least 1 pair seen since; record more")
    positions_net = kbmap.net[:POSITION_OUTPUTS]
    oriented = KBMap(kbmap.bases, np.concatenate([positions_net, chain.orientation_maps(kbmap.bases)]))
    layer = ToolLayer(oriented, spread=math.inf, outlier_sigmas=_OUTLIER_SIGMAS)
    layer.learn(angles, positions, sigma)
    net = kbmap.net.copy()
    net[:POSITION_OUTPUTS] = oriented.with_tool(layer.shift).net[:POSITION_OUTPUTS]
    return KBMap(kbmap.bases, net, kbmap.metadata)
