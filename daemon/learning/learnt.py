"""What a model that answers has to be able to do."""

from __future__ import annotations

from typing import Protocol

from kbmaps import PositionModel


class LearntModel(PositionModel, Protocol):
    """A map from joint angles to positions that later learning does not touch."""

    @property
    def digest(self) -> str:
        """Hash that tells it from any other."""
        ...

    def to_bytes(self) -> bytes:
        """The model as one self-describing byte string."""
        ...
