"""Conversion of joint bases to and from the form of a stored model."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

from kbmaps.errors import BasisError, ModelFormatError
from kbmaps.maps.basis import PARAMETER_NAMES, BasisKind, JointBasis


def describe_bases(bases: Sequence[JointBasis]) -> list[list[Any]]:
    """Return bases as JSON holds them: [kind, parameters...] each."""
    return [[basis.kind, *basis.parameters] for basis in bases]


def parse_bases(value: Any) -> tuple[JointBasis, ...]:
    """Return the bases from `describe_bases`. Raises ModelFormatError."""
    if not isinstance(value, list) or not value:
        raise ModelFormatError("the bases are not a list of at least one")
    return tuple(_parse_basis(entry) for entry in cast(list[Any], value))


def _parse_basis(entry: Any) -> JointBasis:
    parts = cast(list[Any], entry) if isinstance(entry, list) else []
    kind: Any = parts[0] if parts else None
    numbers = parts[1:]
    if not isinstance(kind, str) or kind not in PARAMETER_NAMES:
        raise ModelFormatError("a basis is of no known kind")
    if not all(isinstance(number, float) for number in numbers):
        raise ModelFormatError(f"the parameters of a {kind} basis are not all floating-point numbers")
    try:
        return JointBasis(cast(BasisKind, kind), tuple(numbers))
    except BasisError as error:
        raise ModelFormatError(f"the header describes an impossible basis: {error}") from error
