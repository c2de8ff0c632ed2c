"""The calibration board: what is on it, its page, and where it is in an image."""

from .board import Board
from .detector import OTHER_BOARD, BoardDetector, Corners, NotFound

__all__ = ["OTHER_BOARD", "Board", "BoardDetector", "Corners", "NotFound"]
