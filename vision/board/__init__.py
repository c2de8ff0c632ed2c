"""The calibration board: its pattern, its printable page, and its detection in images."""

from .board import Board
from .detector import OTHER_BOARD, BoardDetector, Corners, NotFound

__all__ = ["OTHER_BOARD", "Board", "BoardDetector", "Corners", "NotFound"]
