"""A rigid chain as arrays of a stored model."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from kbmaps.arrays import FloatArray
from kbmaps.chains.chain import RigidChain


def chain_arrays(chain: RigidChain) -> dict[str, FloatArray]:
    """A chain as arrays to pack."""
    return {"fixed": chain.fixed, "axes": chain.axes, "prismatic": chain.prismatic.astype(np.float64)}


def chain_from_arrays(arrays: Mapping[str, FloatArray]) -> RigidChain:
    """The chain in unpacked arrays. Raises KeyError (one is missing), ChainError, ShapeError, NonFiniteError."""
    return RigidChain(arrays["fixed"], arrays["axes"], arrays["prismatic"] != 0.0)
