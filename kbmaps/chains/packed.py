"""Conversion of a rigid chain to and from the arrays of a stored model."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, fields
from typing import Any

import numpy as np

from kbmaps.arrays import FloatArray
from kbmaps.chains.chain import RigidChain
from kbmaps.chains.parameters import ChainTolerances
from kbmaps.errors import ModelFormatError
from kbmaps.packed import named, or_infinite, unless_infinite

CHAIN = ("fixed", "axes", "prismatic")


def chain_arrays(chain: RigidChain) -> dict[str, FloatArray]:
    """Return a chain as arrays to pack."""
    return {"fixed": chain.fixed, "axes": chain.axes, "prismatic": chain.prismatic.astype(np.float64)}


def chain_from_arrays(arrays: Mapping[str, FloatArray]) -> RigidChain:
    """Return the chain in unpacked arrays.

    Raises:
        KeyError (an array is missing), ModelFormatError, ChainError, ShapeError, NonFiniteError.
    """
    if not np.isin(arrays["prismatic"], (0.0, 1.0)).all():
        raise ModelFormatError("it is not said of every joint whether it slides")
    return RigidChain(arrays["fixed"], arrays["axes"], arrays["prismatic"] != 0.0)


def describe_tolerances(tolerances: ChainTolerances) -> dict[str, float | None]:
    """Return tolerances as JSON holds them: None for an infinite one."""
    return {name: unless_infinite(value) for name, value in asdict(tolerances).items()}


def parse_tolerances(value: Any) -> ChainTolerances:
    """Return the tolerances from `describe_tolerances`. Raises ModelFormatError, SettingError."""
    names = [field.name for field in fields(ChainTolerances)]
    described = named(value, "the tolerances", names)
    return ChainTolerances(*(or_infinite(described[name], f"the tolerance {name}") for name in names))
