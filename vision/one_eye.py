"""Where one camera alone begins: a first pose of points that it knows."""

from __future__ import annotations

import cv2
import numpy as np

from bodyschema.interfaces.camera import StereoCalibration
from bodyschema.interfaces.records import FloatArray


def first_pose(
    calibration: StereoCalibration, points: FloatArray, pixels: FloatArray
) -> list[tuple[FloatArray, FloatArray]]:
    """Poses under which points of a body (k, 3) [m] are seen near `pixels` (k, 2): rotation (3, 3) and origin (3,) [m].

    The least squares of the points off their rays in space, without a first guess (SQPnP: Terzakis and Lourakis 2020).
    Empty where there is none.
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
