"""Conversion of a model to a KB-Map from values on a grid of three values per joint."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from kbmaps.arrays import FloatArray
from kbmaps.chains.carried import Predictor
from kbmaps.maps.basis import JointBasis, check_net_size
from kbmaps.maps.kbmap import POSITION_OUTPUTS, KBMap

_THIRD_OF_A_TURN = 2.0 * math.pi / 3.0


def sampled_map(model: Predictor, bases: Sequence[JointBasis]) -> KBMap:
    """Return the KB-Map in these bases that agrees with a model at 3^d configurations (2 for each prismatic joint).

    If the model is a KB-Map in another form, such as a rigid chain or a kernel learner around one, they agree
    everywhere.

    Raises:
        NetSizeError: more than 3^13 control points.
        BasisError, and errors of the model for joint values outside its domain.
    """
    check_net_size(bases, POSITION_OUTPUTS)
    nodes = [_nodes(basis) for basis in bases]
    grid = np.stack(np.meshgrid(*nodes, indexing="ij"), axis=-1).reshape(-1, len(nodes))
    net = model.predict(grid).T.reshape(3, *(len(values) for values in nodes))
    for k, (basis, values) in enumerate(zip(bases, nodes, strict=True)):
        solved = np.linalg.inv(basis.weights(values))
        net = np.moveaxis(np.tensordot(solved, net, axes=(1, k + 1)), 0, k + 1)
    return KBMap(tuple(bases), net)


def _nodes(basis: JointBasis) -> FloatArray:
    """Return values at which the basis functions differ well: the ends of the range and the middle [rad, m]."""
    if basis.is_prismatic:
        return np.array(basis.parameters[:2])
    if basis.kind == "orthonormal":
        low, high, _ = basis.parameters
        centre, reach = 0.5 * (low + high), 0.5 * (high - low)
    elif basis.kind == "bernstein":
        reach, centre = basis.parameters
    else:
        centre, reach = 0.0, _THIRD_OF_A_TURN
    return centre + min(reach, _THIRD_OF_A_TURN) * np.array([-1.0, 0.0, 1.0])
