"""Estimate a first pose of known points from one camera alone."""

from __future__ import annotations

import cv2
import numpy as np

from bodyschema.interfaces.camera import StereoCalibration
from bodyschema.interfaces.records import FloatArray


def first_pose(
    calibration: StereoCalibration, points: FloatArray, pixels: FloatArray
) -> list[tuple[FloatArray, FloatArray]]:
    """Return the poses, as rotation (3, 3) and origin (3,) [m], with which `points` project near `pixels`.

    Least squares of the points' distances from their rays in space, without an initial guess (SQPnP: Terzakis and
    Lourakis 2020). The list is empty if there is no solution.

    Args:
        points: points of a body in its own frame (k, 3) [m].
        pixels: their image coordinates (k, 2) [px].
    """
    rays = (pixels - np.array(calibration.principal_point_px)) / calibration.focal_px
    found, turns, places, _ = cv2.solvePnPGeneric(
        points, rays[:, None], np.eye(3), np.zeros(5), flags=cv2.SOLVEPNP_SQPNP
    )
    if not found:
        return []
    return [
        (np.asarray(cv2.Rodrigues(turn)[0], np.float64), np.ravel(np.asarray(place, np.float64)))
        for turn, place in zip(turns, places, strict=True)
    ]
