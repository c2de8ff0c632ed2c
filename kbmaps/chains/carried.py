"""Serialisation of a model that serves as the prior of another one."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol, cast

import numpy as np
from numpy.typing import ArrayLike

from kbmaps.arrays import FloatArray, rows_or_vector
from kbmaps.chains.chain import RigidChain
from kbmaps.chains.parameters import chain_arrays, chain_from_arrays
from kbmaps.errors import ModelFormatError
from kbmaps.maps.basis import describe_bases, parse_bases
from kbmaps.maps.kbmap import KBMap
from kbmaps.packed import count


class Predictor(Protocol):
    """Model that predicts positions."""

    def predict(self, q: ArrayLike) -> FloatArray:
        """Return positions (n, 3) [m] at q (n, d) [rad, m], or (3,) at q (d,)."""
        ...


class Origin:
    """Predictor of the origin of the measurement frame everywhere: the prior without any knowledge."""

    def __init__(self, joints: int) -> None:
        self.joints = joints

    def predict(self, q: ArrayLike) -> FloatArray:
        """Return zeros (n, 3), or (3,) at q (d,)."""
        return np.zeros((*rows_or_vector("q", q, self.joints).shape[:-1], 3))


def packable(model: object) -> tuple[dict[str, Any], dict[str, FloatArray]]:
    """Return fields and arrays for `kbmaps.packed` from which `unpacked` restores the model.

    For any other type than `KBMap`, `RigidChain` or `Origin`, only the type's name is stored.
    """
    if isinstance(model, KBMap):
        bases = describe_bases(model.bases)
        return {"type": "KBMap", "bases": bases, "outputs": len(model.net)}, {"net": model.net.reshape(-1)}
    if isinstance(model, RigidChain):
        return {"type": "RigidChain"}, chain_arrays(model)
    if isinstance(model, Origin):
        return {"type": "Origin", "joints": model.joints}, {}
    return {"type": type(model).__name__}, {}


def unpacked(fields: Any, arrays: Mapping[str, FloatArray], given: object | None) -> Any:
    """Return the model that `packable` described, or the one `given` if its type is not stored in bytes.

    Raises:
        ModelFormatError: the type is not stored, and no model or one of another type was given.
        KeyError, TypeError, ValueError, KBMapsError: the description is damaged.
    """
    described = cast(dict[str, Any], fields) if isinstance(fields, dict) else {}
    name = described.get("type")
    if name == "KBMap":
        bases = parse_bases(described["bases"])
        return KBMap(bases, arrays["net"].reshape(described["outputs"], *(basis.size for basis in bases)))
    if name == "RigidChain":
        return chain_from_arrays(arrays)
    if name == "Origin":
        return Origin(count(described["joints"], "the number of joints"))
    if given is None or type(given).__name__ != name:
        raise ModelFormatError(
            f"the model behind this one, a {name}, does not travel in its bytes: restore it and pass it in"
        )
    return given
