"""Detection of tags in one image, with their corners."""

from __future__ import annotations

from collections.abc import Collection

import cv2
import numpy as np

from bodyschema.interfaces.records import FloatArray, ImageArray, Reason

from .config import TagConfig
from .dictionary import tags_of
from .image import TagImage, measure_tag

# Squares are two where their corners are on the mean so far apart, as a share of the perimeter.
_APART_SHARE = 0.03

Region = tuple[int, int, int, int]
Seen = dict[int, TagImage | Reason]


class TagFinder:
    """Detector of the tags with the given numbers."""

    def __init__(self, config: TagConfig, ids: Collection[int]) -> None:
        """Prepare OpenCV's detector of the dictionary."""
        self._config, self._ids = config, ids
        parameters = cv2.aruco.DetectorParameters()
        parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_NONE  # `measure_tag` does better
        # Else a tag's paper, one module wider all around, is taken for the same square, and the tag is not found.
        parameters.minMarkerDistanceRate = _APART_SHARE
        parameters.perspectiveRemovePixelPerCell = 8  # with OpenCV's 4, small and oblique tags are missed
        self._detector = cv2.aruco.ArucoDetector(tags_of(config.dictionary), parameters)

    def find(self, grey: ImageArray, region: Region | None = None) -> Seen:
        """Find the tags in a region (left, top, right, bottom) of a grey image; a refused tag has its reason."""
        tags: Seen = {}
        for id, rough in self.squares(grey, region):
            if id in self._ids:
                tags[id] = Reason.AMBIGUOUS if id in tags else measure_tag(grey, id, rough, self._config)
        return tags

    def squares(self, grey: ImageArray, region: Region | None = None) -> list[tuple[int, FloatArray]]:
        """Return numbers and rough corners (4, 2) [px] of all tags of the dictionary in a region."""
        x0, y0, x1, y1 = region or (0, 0, grey.shape[1], grey.shape[0])
        corners, ids, _ = self._detector.detectMarkers(np.ascontiguousarray(grey[y0:y1, x0:x1]))
        rough = [np.asarray(quad, dtype=np.float64).reshape(4, 2) + np.array([x0, y0]) for quad in corners]
        return list(zip(_numbers(ids), rough, strict=True))


def _numbers(ids: object) -> list[int]:
    """Return the tag numbers from OpenCV's array (n, 1) or None."""
    return [] if ids is None else [int(id) for id in np.ravel(np.asarray(ids))]
