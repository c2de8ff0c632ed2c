"""Interface of an answering model."""

from __future__ import annotations

from typing import Protocol

from kbmaps import PositionModel


class LearntModel(PositionModel, Protocol):
    """Map from joint angles to positions that later learning does not change."""

    @property
    def digest(self) -> str:
        """Hash that identifies the model."""
        ...

    def to_bytes(self) -> bytes:
        """Return the model as one self-describing byte string."""
        ...
