"""The calibration board: what is on it, its page, and where it is in an image."""

from .board import Board
from .detector import BoardDetector, Corners, NotFound

__all__ = ["Board", "BoardDetector", "Corners", "NotFound"]
