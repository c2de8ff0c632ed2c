"""Dictionaries of tags."""

from __future__ import annotations

from functools import cache
from typing import Any

import cv2

from bodyschema.interfaces.errors import ConfigError
from bodyschema.interfaces.records import FloatArray, frozen_array

from .config import Dictionary
from .edge import MODULES

# OpenCV's numbers of the dictionaries.
DICTIONARIES: dict[Dictionary, int] = {
    "apriltag_36h11": cv2.aruco.DICT_APRILTAG_36h11,
    "aruco_6x6_50": cv2.aruco.DICT_6X6_50,
    "aruco_6x6_100": cv2.aruco.DICT_6X6_100,
    "aruco_6x6_250": cv2.aruco.DICT_6X6_250,
    "aruco_6x6_1000": cv2.aruco.DICT_6X6_1000,
    "aruco_mip_36h12": cv2.aruco.DICT_ARUCO_MIP_36h12,
}

# Dictionaries that are common elsewhere, and are printed by mistake.
OTHER_DICTIONARIES: dict[str, int] = {
    "apriltag_25h9": cv2.aruco.DICT_APRILTAG_25h9,
    "apriltag_16h5": cv2.aruco.DICT_APRILTAG_16h5,
    "aruco_4x4": cv2.aruco.DICT_4X4_1000,
    "aruco_5x5": cv2.aruco.DICT_5X5_1000,
    "aruco_7x7": cv2.aruco.DICT_7X7_1000,
    "aruco_original": cv2.aruco.DICT_ARUCO_ORIGINAL,
}


def tags_of(name: Dictionary) -> Any:
    """Return the OpenCV dictionary with that name."""
    return cv2.aruco.getPredefinedDictionary(DICTIONARIES[name])


def require_tag(name: Dictionary, id: int) -> None:
    """Raise ConfigError if the dictionary has no tag with that number."""
    most = len(tags_of(name).bytesList)
    if not 0 <= id < most:
        raise ConfigError(f"there is no tag {id} in {name}", remedy=f"Its numbers go from 0 to {most - 1}")


@cache
def tag_modules(name: Dictionary, id: int) -> FloatArray:
    """Return a tag's modules with its black border, rows from the top, shape (8, 8), 1 white and 0 black.

    Raises:
        ConfigError: there is no such tag.
    """
    require_tag(name, id)
    return frozen_array(cv2.aruco.generateImageMarker(tags_of(name), id, int(MODULES)) > 127)
