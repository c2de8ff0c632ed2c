"""Check of a calibration from one view of the board."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.distance import pdist

from bodyschema.interfaces.records import FloatArray
from bodyschema.vision.board import Board
from bodyschema.vision.rig.rectified import Rectification
from bodyschema.vision.rig.stereo_rig import CalibrationError, StereoRig, covariance_of, triangulated

from .view import View


class _Settings:
    """Settings of the check: how much may change without a warning."""

    min_corners, sigmas = 8, 4.0  # corners that both eyes see; multiple of the uncertainty
    # Drift allowed for focus, temperature and a bent board, beyond the covariance: of rows, and of a square's size.
    free_rows_px, free_square = 0.15, 0.002
    step_px = 1e-3  # for derivatives
    # Exchanged or upside-down images are recognised if correcting them reduces the row differences to this share, with
    # square sizes right within this share.
    misplaced_rows, misplaced_size = 0.1, 0.03


@dataclass(frozen=True)
class Check:
    """Result of a check with one view."""

    corners: int  # number of corners seen by both eyes
    epipolar_px: float  # RMS difference of the rows at which the two rectified images show a corner [px]
    # rows_px, rows_sigma_px: mean of the differences, and its 1-sigma from calibration and noise [px]
    rows_px: float
    rows_sigma_px: float
    # roll_deg, roll_sigma_deg: rotation of one eye about its line of sight, from the differences [deg]
    roll_deg: float
    roll_sigma_deg: float
    # square_m, square_sigma_m: measured side of the board's squares [m]
    square_m: float
    square_sigma_m: float
    nominal_m: float  # true side of the board's squares [m]
    wrong: tuple[str, ...]  # messages for figures that no longer hold; empty if the calibration holds

    @property
    def holds(self) -> bool:
        """True if the calibration still holds."""
        return not self.wrong


def check(rig: StereoRig, view: View, board: Board) -> Check:
    """Check a calibration with one view of the board.

    Raises:
        CalibrationError: one of the eyes does not see enough of the board.
    """
    numbers, left, right = _shared(view)
    if len(numbers) < (needed := _Settings.min_corners):
        raise CalibrationError(
            f"both eyes see {len(numbers)} corners of the board, at least {needed} are needed. Hold it into the "
            "middle of both images"
        )
    model = board.corners_m[numbers]
    covariance = covariance_of(rig, lambda other: _figures(other, left, right, model))
    covariance = covariance + rig.provenance.held_out_px**2 * _noise_covariance(rig, left, right, model)
    # From focal lengths, radians and shares to display units.
    focal = Rectification(rig).calibration.focal_px
    units = np.array([focal, np.degrees(1.0), board.square_m])
    found = units * _figures(rig, left, right, model)
    sigma = units * np.sqrt(np.diag(covariance))
    wrong = _violations(found, sigma, focal, rig.image_size_px[0], board.square_m)
    if wrong and (misplacement := _misplacement(rig, left, right, model)) is not None:
        wrong = [misplacement]
    return Check(
        len(numbers),
        focal * _rms_row_difference(rig, left, right),
        *(float(each) for pair in zip(found, sigma, strict=True) for each in pair),
        nominal_m=board.square_m,
        wrong=tuple(wrong),
    )


def _shared(view: View) -> tuple[np.ndarray, FloatArray, FloatArray]:
    if view.left is None or view.right is None:
        empty = np.zeros((0, 2))
        return np.zeros(0, dtype=np.int64), empty, empty
    numbers, a, b = np.intersect1d(view.left.numbers, view.right.numbers, return_indices=True)
    return numbers, view.left.px[a], view.right.px[b]


def _row_differences(rig: StereoRig, left: FloatArray, right: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the right image's row minus the left one's for each corner, and the position along the row [focal
    lengths].
    """
    rectification = Rectification(rig)
    here, there = rectification.directions(left, 0), rectification.directions(right, 1)
    return there[:, 1] - here[:, 1], there[:, 0]


def _rms_row_difference(rig: StereoRig, left: FloatArray, right: FloatArray) -> float:
    """Return the RMS difference of the rows, in focal lengths."""
    return float(np.sqrt(np.mean(_row_differences(rig, left, right)[0] ** 2)))


def _misplacement(rig: StereoRig, left: FloatArray, right: FloatArray, model: FloatArray) -> str | None:
    """Return a message if the calibration would hold for images exchanged or turned upside down, else None."""
    turned_left, turned_right = (np.array(rig.image_size_px) - 1.0 - px for px in (left, right))
    placed = (
        ("left and right are exchanged: exchange the cameras, or their names where they are configured", right, left),
        ("the left image is upside down: turn that camera, or its images", turned_left, right),
        ("the right image is upside down: turn that camera, or its images", left, turned_right),
        ("both images are upside down: turn both cameras, or their images", turned_left, turned_right),
    )
    max_difference = _Settings.misplaced_rows * _rms_row_difference(rig, left, right)
    for text, one, other in placed:
        size = _figures(rig, one, other, model)[2]
        if _rms_row_difference(rig, one, other) < max_difference and abs(size - 1.0) < _Settings.misplaced_size:
            return text
    return None


def _figures(rig: StereoRig, left: FloatArray, right: FloatArray, model: FloatArray) -> FloatArray:
    """Return the mean row difference, its slope along the rows [rad], and the ratio of measured to true board size."""
    rows, at = _row_differences(rig, left, right)
    along = at - at.mean()
    seen, true = pdist(triangulated(rig, left, right)), pdist(model)
    return np.array([rows.mean(), along @ rows / (along @ along), seen @ true / (true @ true)])


def _noise_covariance(rig: StereoRig, left: FloatArray, right: FloatArray, model: FloatArray) -> FloatArray:
    """Return the covariance of the figures for noise of 1 px in every image coordinate."""
    px = np.concatenate([left, right])
    slopes = []
    for place in np.ndindex(px.shape):
        moved = px.copy()
        moved[place] += _Settings.step_px
        slopes.append(_figures(rig, moved[: len(left)], moved[len(left) :], model))
    J = (np.array(slopes) - _figures(rig, left, right, model)) / _Settings.step_px
    return J.T @ J


def _violations(found: FloatArray, sigma: FloatArray, focal_px: float, width_px: int, nominal_m: float) -> list[str]:
    rows_px, roll_deg, square_m = found.tolist()
    tolerance = np.array(
        [_Settings.free_rows_px, np.degrees(4.0 * _Settings.free_rows_px / width_px), _Settings.free_square * nominal_m]
    )
    exceeds = np.abs(found - np.array([0.0, 0.0, nominal_m])) > _Settings.sigmas * sigma + tolerance
    texts = (
        f"rows are {rows_px:+.2f} px apart: a camera has been turned up or down by "
        f"{np.degrees(abs(rows_px) / focal_px):.2f}°",
        f"a camera has been turned about its line of sight by {abs(roll_deg):.2f}°",
        f"a square of {1e3 * nominal_m:g} mm is measured as {1e3 * square_m:.2f} mm: a camera has been turned inwards "
        f"or outwards, moved or refocused, or the board is another one, or printed at {square_m / nominal_m:.1%}",
    )
    wrong = [text for text, is_off in zip(texts, exceeds, strict=True) if is_off]
    return (
        [*wrong, "all at once, so that these may be other cameras than those that were calibrated"]
        if exceeds.all()
        else wrong
    )
