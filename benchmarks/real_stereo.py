"""Calibration of public stereo pairs of a chessboard, compared with OpenCV's.

Run `python benchmarks/real_stereo.py [FOLDER] [--left PATTERN --right PATTERN] [--squares 10x7] [--square-mm 25]`.

The default is OpenCV's own sample pairs: left01.jpg to right14.jpg, which its sources have in samples/data and Debian's
package opencv-doc in /usr/share/doc/opencv-doc/examples/data. No images are in this repository.

Both calibrate from the same corners: once from all views, then from three quarters of the pairs, to predict the corners
of every fourth pair. OpenCV uses the lens model that is chosen here; the 1-sigma of its baseline is a delete-one
jackknife over the pairs. If OpenCV finds no initial values for a fisheye lens, it gets ours.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from bodyschema.cli.cameras.calibration import board_of
from bodyschema.interfaces.records import FloatArray
from bodyschema.vision.board import Board
from bodyschema.vision.calibration.bundle import view_residuals
from bodyschema.vision.calibration.calibrate import Calibrated, CalibrationRequest, calibrate, fit
from bodyschema.vision.calibration.gather import gathered
from bodyschema.vision.calibration.image_pairs import pair_files, read_pairs
from bodyschema.vision.calibration.initial_estimate import pose_of
from bodyschema.vision.calibration.view import View
from bodyschema.vision.rig.lens import DISTORTION_NAMES, Model
from bodyschema.vision.rig.stereo_rig import StereoRig, parameter_names, split

USUAL = Path("/usr/share/doc/opencv-doc/examples/data")
EVERY = 4


def main() -> None:
    """Calibrate, and print the figures beside those of OpenCV from the same corners."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, nargs="?", default=USUAL)
    parser.add_argument("--left", default="left[0-9]*.jpg")
    parser.add_argument("--right", default="right[0-9]*.jpg")
    parser.add_argument("--squares", default="10x7")
    parser.add_argument("--square-mm", type=float, default=25.0)
    given = parser.parse_args()
    if not given.folder.is_dir():
        print(f"{given.folder} is not there: name the folder with OpenCV's left01.jpg and right01.jpg")
        return
    board = board_of(given.squares, given.square_mm, pattern="chessboard")
    pairs = pair_files(given.folder, given.left, given.right, side_by_side=False)
    found = gathered(read_pairs(pairs, side_by_side=False), board, print)
    show(found.views, board, found.image_size_px)


def show(views: Sequence[View], board: Board, size_px: tuple[int, int]) -> None:
    """Print the table of both calibrations."""
    ours = calibrate(views, board, CalibrationRequest(size_px, ("", ""), "", scale_sigma=0.0), print)
    pairs = [view for view in views if view.is_stereo]
    theirs = opencv(pairs, board, size_px, ours.rig.model)
    if theirs is None:
        theirs = opencv(pairs, board, size_px, ours.rig.model, ours.rig.vector)
    for row in (("", "ours", "1 sigma", "OpenCV"), *rows(ours, theirs)):
        print("{:28s}{:>12s}{:>12s}{:>12s}".format(*row))
    if theirs is not None:
        others = [
            opencv([*pairs[:k], *pairs[k + 1 :]], board, size_px, ours.rig.model, theirs) for k in range(len(pairs))
        ]
        places = np.array([each[-3:] for each in others if each is not None])
        sigma = np.sqrt(len(places) - 1) * np.std(np.linalg.norm(places, axis=1))
        print(f"OpenCV's baseline, 1 sigma [mm]: {1e3 * sigma:.3f}")
    kept = [view for view in ours.fitted.views if view.is_stereo]
    taken = [view for k, view in enumerate(kept) if k % EVERY]
    part = fit(taken, board.corners_m, size_px, ours.rig.model).bundle.vector
    apart = [
        "" if vector is None else f"{predicted(kept[::EVERY], board, ours.rig.model, vector):.3f}"
        for vector in (part, opencv(taken, board, size_px, ours.rig.model, theirs))
    ]
    print("{:28s}{:>12s}{:>12s}{:>12s}".format("RMS a point, every fourth", apart[0], "", apart[1]))


def rows(ours: Calibrated, theirs: FloatArray | None) -> list[tuple[str, str, str, str]]:
    """Return the name, our value, its sigma and OpenCV's value of each row."""
    rig = ours.rig
    assert isinstance(rig, StereoRig)
    n = len(rig.vector) if theirs is None else len(theirs)
    other = np.full(n, np.nan) if theirs is None else theirs
    table = [
        (name, f"{value:.3f}", f"{sigma:.3f}", f"{its:.3f}")
        for name, value, sigma, its in zip(rig.names, rig.vector, rig.sigma, other, strict=True)
        if name.endswith(("f_px", "fx_px", "fy_px", "cx_px", "cy_px"))
    ]
    distance = 1e3 * float(np.linalg.norm(other[-3:]))
    baseline = f"{1e3 * rig.baseline_m:.3f}", f"{1e3 * rig.baseline_sigma_m:.3f}", f"{distance:.3f}"
    # A point has two coordinates.
    errors = [f"{np.sqrt(2) * each:.3f}" for each in (rig.provenance.reprojection_px, rig.provenance.held_out_px)]
    return [
        *table,
        ("baseline [mm]", *baseline),
        ("RMS a point [px]", errors[0], "", ""),
        ("RMS a point, held out [px]", errors[1], "", ""),
    ]


def predicted(views: Sequence[View], board: Board, model: Model, vector: FloatArray) -> float:
    """Return the RMS error of a point [px] in views of which only the poses are fitted."""
    left = split(model, vector)[0]
    squares, points = 0.0, 0
    for view in views:
        assert view.left is not None
        start = pose_of(view.left, board.corners_m, left)
        off = view_residuals(view, board.corners_m, model, vector, start, np.ones(view.corner_count))
        squares, points = squares + float(np.sum(off**2)), points + len(off)
    return float(np.sqrt(squares / points))


def opencv(
    views: Sequence[View], board: Board, size_px: tuple[int, int], model: Model, known: FloatArray | None = None
) -> FloatArray | None:
    """Return the rig of OpenCV's own calibration, in the order of `StereoRig.vector`; None if it fails.

    Args:
        known: a rig whose lenses are the initial values, instead of a calibration of each eye alone.
    """
    eyes = [(view.left, view.right) for view in views if view.left is not None and view.right is not None]
    corners = [board.corners_m[each.numbers][None].astype(np.float32) for each, _ in eyes]
    left, right = ([each[eye].px[None].astype(np.float32) for each in eyes] for eye in range(2))
    start = None if known is None else [(lens.matrix, np.array([lens.distortion])) for lens in split(model, known)[:2]]
    try:
        if model == "fisheye":
            flags = cv2.CALIB_RECOMPUTE_EXTRINSIC | cv2.CALIB_FIX_SKEW
            start = start or [
                cv2.fisheye.calibrate(corners, px, size_px, np.eye(3), np.zeros(4), flags=flags)[1:3]
                for px in (left, right)
            ]
            flags |= cv2.CALIB_USE_INTRINSIC_GUESS
            found = cv2.fisheye.stereoCalibrate(corners, left, right, *start[0], *start[1], size_px, flags=flags)
        else:
            flags = cv2.CALIB_RATIONAL_MODEL if model == "rational" else 0
            count = len(DISTORTION_NAMES[model])
            start = start or [
                cv2.calibrateCamera(corners, px, size_px, np.eye(3), np.zeros(count), flags=flags)[1:3]
                for px in (left, right)
            ]
            flags |= cv2.CALIB_USE_INTRINSIC_GUESS
            found = cv2.stereoCalibrate(corners, left, right, *start[0], *start[1], size_px, flags=flags)
    except cv2.error as error:
        print(f"OpenCV fails: {error.err}")
        return None
    count = len(DISTORTION_NAMES[model])
    lenses = [
        [K[0, 0], K[1, 1], K[0, 2], K[1, 2], *np.ravel(D)[:count]]
        for K, D in ((found[1], found[2]), (found[3], found[4]))
    ]
    turn = Rotation.from_matrix(np.asarray(found[5])).as_rotvec()
    vector = np.concatenate([*lenses, turn, np.ravel(found[6])])
    assert len(vector) == len(parameter_names(model))
    return vector


if __name__ == "__main__":
    main()
