"""Detection of tags in one image, with their corners."""

from __future__ import annotations

import logging
from collections.abc import Collection
from typing import Any

import cv2
import numpy as np

from bodyschema.interfaces.records import FloatArray, ImageArray, Reason

from .config import TagConfig
from .dictionary import DICTIONARIES, OTHER_DICTIONARIES, require_tag, tags_of
from .image import TagImage, measure_tag
from .settings import TagSettings as _Settings

_log = logging.getLogger(__name__)


Region = tuple[int, int, int, int]
Seen = dict[int, TagImage | Reason]


class TagFinder:
    """Detector of the tags with the given numbers."""

    def __init__(self, config: TagConfig, ids: Collection[int]) -> None:
        """Prepare OpenCV's detector of the dictionary; raise ConfigError if a tag's number is not in it."""
        for id in ids:
            require_tag(config.dictionary, id)
        self._config, self._ids = config, ids
        self._detector = _detector(tags_of(config.dictionary))
        self._suspect, self._warned = 0, False
        # Among ArUco's six by six dictionaries, each is the beginning of the next.
        kinds = {"apriltag_36h11", "aruco_6x6_1000", "aruco_mip_36h12"} - {config.dictionary}
        self._others = {name: number for name, number in DICTIONARIES.items() if name in kinds} | OTHER_DICTIONARIES
        if config.dictionary.startswith("aruco_6x6"):
            del self._others["aruco_6x6_1000"]

    def suspicion(self, grey: ImageArray) -> Reason | None:
        """Return the likely cause of missing tags: a mirrored tag, or one of another dictionary.

        Each call searches for one of these, in turn, and keeps what it finds.
        """
        names = ["", *self._others]
        name = names[self._suspect]
        if not name:
            mirrored_ids = {id for id, _ in _seen(self._detector, np.ascontiguousarray(grey[:, ::-1]))} & set(self._ids)
            reason = Reason.MIRRORED if mirrored_ids else None
        else:
            detector = _detector(cv2.aruco.getPredefinedDictionary(self._others[name]), exact=True)
            large = [
                quad for _, quad in _seen(detector, grey) if cv2.arcLength(quad, True) > 4.0 * _Settings.min_side_px
            ]
            reason = Reason.OTHER_FAMILY if large else None
        if reason is None:
            self._suspect, self._warned = (self._suspect + 1) % len(names), False
        elif not self._warned:
            self._warned = True
            kind = f"tag of {name}" if name else "mirrored tag"
            _log.warning("a %s is in view, not one of %s", kind, self._config.dictionary)
        return reason

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
        found = _seen(self._detector, np.ascontiguousarray(grey[y0:y1, x0:x1]))
        return [(id, np.asarray(quad, dtype=np.float64) + np.array([x0, y0])) for id, quad in found]


def _detector(dictionary: Any, *, exact: bool = False) -> cv2.aruco.ArucoDetector:
    """Return a detector of a dictionary; if `exact`, only of tags without a wrong module."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_NONE  # `measure_tag` does better
    # Otherwise a tag's paper, one module wider all around, counts as the same square, and the tag is missed.
    parameters.minMarkerDistanceRate = _Settings.apart_share
    parameters.perspectiveRemovePixelPerCell = 8  # with OpenCV's 4, small and oblique tags are missed
    if exact:
        parameters.errorCorrectionRate = parameters.maxErroneousBitsInBorderRate = 0.0
    return cv2.aruco.ArucoDetector(dictionary, parameters)


def _seen(detector: cv2.aruco.ArucoDetector, grey: ImageArray) -> list[tuple[int, Any]]:
    """Return numbers and corners (4, 2) [px] of the tags in an image."""
    corners, ids, _ = detector.detectMarkers(grey)
    # OpenCV's array is (n, 1) or None.
    return (
        []
        if ids is None
        else [(int(id), np.reshape(quad, (4, 2))) for id, quad in zip(np.ravel(np.asarray(ids)), corners, strict=True)]
    )
