"""The calibration of OpenCV's own sample pairs: `python benchmarks/real_stereo.py FOLDER`.

FOLDER has left01.jpg to right14.jpg, which OpenCV's sources have in samples/data and Debian's package opencv-doc in
/usr/share/doc/opencv-doc/examples/data. They are not in this repository. 9x6 inner corners, squares of 25 mm.
"""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np

from bodyschema.vision.board import Board
from bodyschema.vision.calibration.calibrate import Asked, Calibrated, calibrate
from bodyschema.vision.calibration.gather import gathered
from bodyschema.vision.calibration.images import pair_files, read_pairs
from bodyschema.vision.calibration.view import View
from bodyschema.vision.rig import StereoRig

BOARD = Board(10, 7, 0.025, pattern="chessboard")
USUAL = Path("/usr/share/doc/opencv-doc/examples/data")


def main() -> None:
    """Calibrate, and print the figures beside those of OpenCV from the same corners."""
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else USUAL
    if not folder.is_dir():
        print(f"{folder} is not there: name the folder with OpenCV's left01.jpg and right01.jpg")
        return
    pairs = pair_files(folder, "left[0-9]*.jpg", "right[0-9]*.jpg", side_by_side=False)
    found = gathered(read_pairs(pairs, side_by_side=False), BOARD, print)
    asked = Asked(found.image_size_px, ("", ""), "", scale_sigma=0.0)
    ours = calibrate(found.views, BOARD, asked)
    for row in (("", "ours", "1 sigma", "OpenCV"), *rows(ours, opencv(found.views, found.image_size_px))):
        print("{:28s}{:>12s}{:>12s}{:>12s}".format(*row))


def rows(ours: Calibrated, theirs: dict[str, float]) -> list[tuple[str, str, str, str]]:
    """Name, our value, its sigma and OpenCV's value."""
    rig = ours.rig
    assert isinstance(rig, StereoRig)
    values = dict(zip(rig.names, zip(rig.vector.tolist(), rig.sigma.tolist(), strict=True), strict=True))
    wanted = (
        "left.fx_px",
        "left.cx_px",
        "left.cy_px",
        "left.k1",
        "right.fx_px",
        "right.cx_px",
        "right.cy_px",
        "right.k1",
    )
    table = [(name, f"{values[name][0]:.3f}", f"{values[name][1]:.3f}", f"{theirs[name]:.3f}") for name in wanted]
    baseline = f"{1e3 * rig.baseline_m:.3f}", f"{1e3 * rig.baseline_sigma_m:.3f}", f"{1e3 * theirs['baseline_m']:.3f}"
    table.append(("baseline [mm]", *baseline))
    # OpenCV counts a point's distance, of two coordinates.
    table.append(("RMS a point [px]", f"{np.sqrt(2) * rig.made.reprojection_px:.3f}", "", f"{theirs['rms_px']:.3f}"))
    table.append(("RMS a point, held out [px]", f"{np.sqrt(2) * rig.made.held_out_px:.3f}", "", ""))
    return table


def opencv(views: list[View], size_px: tuple[int, int]) -> dict[str, float]:
    """Calibrate with cv2.calibrateCamera, then cv2.stereoCalibrate, from the views that both cameras saw."""
    eyes = [(view.left.px, view.right.px) for view in views if view.left is not None and view.right is not None]
    model = [BOARD.corners_m.astype(np.float32)] * len(eyes)
    left, right = ([px[eye].astype(np.float32) for px in eyes] for eye in range(2))
    start = [cv2.calibrateCamera(model, px, size_px, np.eye(3), np.zeros(5))[1:3] for px in (left, right)]
    flags = cv2.CALIB_USE_INTRINSIC_GUESS
    rms, K1, D1, K2, D2, _, t, *_ = cv2.stereoCalibrate(model, left, right, *start[0], *start[1], size_px, flags=flags)
    found = {"rms_px": float(rms), "baseline_m": float(np.linalg.norm(t))}
    for eye, K, D in (("left", K1, D1), ("right", K2, D2)):
        values = {"fx_px": K[0, 0], "cx_px": K[0, 2], "cy_px": K[1, 2], "k1": np.ravel(D)[0]}
        found |= {f"{eye}.{name}": float(value) for name, value in values.items()}
    return found


if __name__ == "__main__":
    main()
