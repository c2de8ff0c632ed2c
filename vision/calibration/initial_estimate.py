"""Initial values for the joint fit: each eye by itself, then the right eye's pose from all views of both."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from bodyschema.interfaces.records import FloatArray
from bodyschema.vision.board import Corners
from bodyschema.vision.rig.lens import DISTORTION_NAMES, Lens, Model
from bodyschema.vision.rig.stereo_rig import CalibrationError

from .settings import FitSettings as _Settings
from .view import EYES, Eye, View, seen_by


def start(
    views: Sequence[View],
    corners_m: FloatArray,
    image_size_px: tuple[int, int],
    model: Model,
    eyes: Sequence[Eye] = EYES,
) -> tuple[FloatArray, FloatArray]:
    """Return initial rig parameters and board poses in the left eye's frame, shape (views, 6).

    Raises:
        CalibrationError: no two views were seen by both eyes, or OpenCV finds no lens.
    """
    lenses = {eye: _lens(seen_by(views, eye), corners_m, image_size_px, model, eye) for eye in eyes}
    poses = {
        eye: [None if (seen := view.eye(eye)) is None else pose_of(seen, corners_m, lenses[eye]) for view in views]
        for eye in eyes
    }
    if len(eyes) == 1:
        alone = [pose for pose in poses["left"] if pose is not None]
        return lenses["left"].vector, np.array(alone)
    rotation, translation = _relative_pose(poses["left"], poses["right"])
    in_left = [
        left if left is not None else _in_left_eye(right, rotation, translation)
        for left, right in zip(poses["left"], poses["right"], strict=True)
    ]
    vector = np.concatenate([lenses["left"].vector, lenses["right"].vector, rotation.as_rotvec(), translation])
    return vector, np.array(in_left)


def pose_of(seen: Corners, corners_m: FloatArray, lens: Lens) -> FloatArray:
    """Return the board's pose in an eye's frame: rotation vector [rad] and position [m], shape (6,)."""
    model = corners_m[seen.numbers]
    directions = lens.directions(seen.px)
    _, rotations, translations, _ = cv2.solvePnPGeneric(
        model, directions[:, None], np.eye(3), np.zeros(5), flags=cv2.SOLVEPNP_IPPE
    )
    found = [
        np.concatenate([r.ravel(), t.ravel()], dtype=np.float64) for r, t in zip(rotations, translations, strict=True)
    ]
    return min(found, key=lambda pose: float(np.sum((lens.project_posed(model, pose[:3], pose[3:])[0] - seen.px) ** 2)))


def _lens(seen: Sequence[Corners], corners_m: FloatArray, size_px: tuple[int, int], model: Model, eye: Eye) -> Lens:
    if len(seen) < 3:
        raise CalibrationError(f"the board is in {len(seen)} {eye} images. Take at least 3, better 20")
    if model == "fisheye":
        return min(
            (_fisheye(seen, corners_m, size_px, share) for share in _Settings.fisheye_focals), key=lambda each: each[1]
        )[0]
    count = len(DISTORTION_NAMES[model])
    try:
        _, matrix, distortion, _, _ = cv2.calibrateCamera(
            [corners_m[each.numbers].astype(np.float32) for each in seen],
            [each.px.astype(np.float32) for each in seen],
            size_px,
            np.eye(3),
            np.zeros(count),
            flags=cv2.CALIB_RATIONAL_MODEL if model == "rational" else 0,
        )
    except cv2.error as error:
        raise CalibrationError(
            f"the {eye} eye's views do not determine its lens. Tilt the board in some of them, by 20° and more"
        ) from error
    return Lens(
        model,
        (float(matrix[0, 0]), float(matrix[1, 1])),
        (float(matrix[0, 2]), float(matrix[1, 2])),
        tuple(np.ravel(distortion)[:count].tolist()),
    )


def _fisheye(
    seen: Sequence[Corners], corners_m: FloatArray, size_px: tuple[int, int], share: float
) -> tuple[Lens, float]:
    """Return an undistorted fisheye lens with this focal length, and the median residual of its corners [px]."""
    focal = share * size_px[0]
    centre = (0.5 * (size_px[0] - 1), 0.5 * (size_px[1] - 1))
    lens = Lens("fisheye", (focal, focal), centre, (0.0,) * len(DISTORTION_NAMES["fisheye"]))
    try:
        errors = [
            np.linalg.norm(
                lens.project_posed(corners_m[each.numbers], *np.split(pose_of(each, corners_m, lens), 2))[0] - each.px,
                axis=1,
            )
            for each in seen
        ]
    except (cv2.error, np.linalg.LinAlgError, ValueError):
        return lens, np.inf
    return lens, float(np.median(np.concatenate(errors)))


def _relative_pose(
    left: Sequence[FloatArray | None], right: Sequence[FloatArray | None]
) -> tuple[Rotation, FloatArray]:
    """Return the left eye's pose in the right one's frame, as a median over the views."""
    turns, places = [], []
    for a, b in zip(left, right, strict=True):
        if a is None or b is None:
            continue
        turn = Rotation.from_rotvec(b[:3]) * Rotation.from_rotvec(a[:3]).inv()
        turns.append(turn)
        places.append(b[3:] - turn.apply(a[3:]))
    if len(turns) < 2:
        raise CalibrationError(f"both eyes saw the board in {len(turns)} views. Hold it where both see it")
    median_angles = [np.median([(turn * other.inv()).magnitude() for other in turns]) for turn in turns]
    return turns[int(np.argmin(median_angles))], np.median(places, axis=0)


def _in_left_eye(right: FloatArray | None, rotation: Rotation, translation: FloatArray) -> FloatArray:
    """Return the board's pose in the left eye's frame from that in the right one's."""
    if right is None:
        raise CalibrationError("a view that neither eye saw")
    turn = rotation.inv() * Rotation.from_rotvec(right[:3])
    return np.concatenate([turn.as_rotvec(), rotation.inv().apply(right[3:] - translation)])
