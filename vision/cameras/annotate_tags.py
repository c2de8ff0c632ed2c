"""Tags drawn into camera images: the detected ones, and the marker's as predicted from a fix."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from bodyschema.interfaces.camera import StereoCalibration
from bodyschema.interfaces.records import FloatArray, ImageArray, MarkerFix, Reason
from bodyschema.vision.config import VisionConfig

SUBPIXEL_BITS = 4
AXES = ((60, 60, 255), (60, 220, 60), (255, 140, 60))  # x, y, z


@dataclass(frozen=True, slots=True)
class TagSight:
    """A tag in one eye's image."""

    id: int
    corners_px: FloatArray  # shape (4, 2), rough if it was refused
    reason: Reason | None  # reason why it is not measured, or None
    is_wanted: bool  # True if it belongs to the marker


class TagDrawing:
    """Annotator of the tags in [vision], and of others of their dictionary."""

    def __init__(self, calibration: StereoCalibration, config: VisionConfig) -> None:
        # They import scipy, which takes half a second and is not needed to track a ball.
        from bodyschema.vision.tags.body import TagBody
        from bodyschema.vision.tags.chessboard import ChessboardFinder
        from bodyschema.vision.tags.dictionary import tags_of
        from bodyschema.vision.tags.finder import TagFinder
        from bodyschema.vision.tags.image import measure_tag

        self._calibration, self._config, self._measured = calibration, config.tag, measure_tag
        self._body, self._rim, self._side_m = TagBody.of(config), [0, 1, 2, 3], config.tag.side_m
        self._finder = TagFinder(config.tag, range(len(tags_of(config.tag.dictionary).bytesList)))
        self._board: ChessboardFinder | None = None
        if config.marker == "chessboard":
            across = config.board.columns - 1
            self._board, self._side_m = ChessboardFinder(config.board), 2.0 * config.board.square_m
            self._rim = [0, across - 1, -1, -across]

    def sights(self, image: ImageArray) -> Iterator[TagSight]:
        """Yield all tags of the dictionary in one eye's image."""
        grey = np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8)
        for found in {} if self._board is None else self._board.find(grey).values():
            if not isinstance(found, Reason):
                yield TagSight(0, found.corners_px[self._rim], None, True)
        for id, rough in [] if self._board is not None else self._finder.squares(grey):
            found = self._measured(grey, id, rough, self._config)
            corners, reason = (rough, found) if isinstance(found, Reason) else (found.corners_px, None)
            yield TagSight(id, corners, reason, id in self._body.corners)

    def draw_fix(self, eyes: list[ImageArray], fix: MarkerFix, colour: tuple[int, int, int]) -> None:
        """Draw the outlines of the marker's tags that face the left eye, and the marker's axes."""
        from scipy.spatial.transform import Rotation

        if fix.R is None:
            return
        turn = Rotation.from_quat(fix.R).as_matrix()
        shown = [corners[self._rim] @ turn.T + fix.x for corners in self._body.corners.values()]
        for corners in shown:
            if np.cross(corners[1] - corners[0], corners[3] - corners[0]) @ corners.mean(axis=0) > 0.0:
                for image, px in zip(eyes, self._seen(corners), strict=False):
                    outline(image, px, colour)
        ends = fix.x + 0.75 * self._side_m * np.vstack([np.zeros(3), turn.T])
        for image, px in zip(eyes, self._seen(ends), strict=False):
            for end, shade in zip(px[1:], AXES, strict=True):
                cv2.line(image, _fixed(px[0]), _fixed(end), shade, 2, cv2.LINE_AA, SUBPIXEL_BITS)

    def _seen(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Project points (n, 3) into the left and a right eye, shape (n, 2) each [px]."""
        px = self._calibration.project(x)
        return px[:, :2], px[:, 2:]


def outline(image: ImageArray, px: FloatArray, colour: tuple[int, int, int]) -> None:
    """Draw a closed line through points (n, 2)."""
    points = [np.round(px * 2**SUBPIXEL_BITS).astype(np.int32)]
    cv2.polylines(image, points, True, colour, 2, cv2.LINE_AA, SUBPIXEL_BITS)


def _fixed(px: FloatArray) -> tuple[int, int]:
    scaled = np.round(px * 2**SUBPIXEL_BITS).astype(int)
    return int(scaled[0]), int(scaled[1])
