"""Settings of the camera calibration and their sensitivity."""

from __future__ import annotations

import numpy as np


class FitSettings:
    """Settings of the fit.

    Sensitivity, each at 0.3 and 3 times over six sets of views of the tests: `farthest` at 0.3 times moves a number by
    2.2 sigma, the other weights by less than 0.15 sigma; `max_left_out` at 0.3 times loses a set. `fisheye_focals` and
    `folds` were not measured; the others change nothing there.
    """

    # A view farther than this from the median, in spreads of all views, is left out; more than this share are too many.
    outlier_spreads, max_left_out = 8.0, 0.35
    # 1-sigma of the last term of the distortion, at the image's corner, where it would fold the image over: a lens of a
    # webcam has 0.01.
    steepest_term = 0.02
    reweighted = 3  # fits with weights from the one before; more change 0.003 sigma
    farthest = 5.0  # 1-sigmas: a corner farther off is an outlier
    group = 60  # corners with squares of similar width
    shared = 6.0  # prior weight of the usual variance, in corners, against an image's own
    # A focal length of its own for each view has to explain this many times what any other freedom explains that views
    # do not have. On nineteen public sets without autofocus it explains at most once as much.
    clearly = 2.0
    false_alarms = 1e-3  # of independent corners
    rounds = 30  # of expectation maximisation; 10 to 1000 change the 1-sigma that is stated by at most 2 %
    fisheye_focals = (0.25, 0.35, 0.5, 0.7, 1.0)  # of the image's width: candidate focal lengths of a fisheye lens
    folds = 10  # parts of the views, each of which is left out once


class ViewSettings:
    """Settings of what views have to show, and of the advice on the next one.

    They refuse a calibration or ask for more views, and change no result. Of six sets of the tests, `min_cells` and
    `min_tilted` at 3 times refuse four or five more, `tilted_deg` two; at 0.3 times none changes more than one.
    `least_views`, `wanted_views`, `corners_a_cell`, `tilted_each_way`, `still_px`, `new_share` and `new_tilt_deg` were
    not measured.
    """

    min_views, wanted_views = 8, 20  # seen by all eyes: fewer are refused, more are not asked for
    min_cells, corners_a_cell = 6, 8  # of nine cells, in which so many corners were seen
    tilted_deg, min_tilted = 10.0, 3  # so many views with a tilt that tells focal length from distance
    # Sigmas are those of whole views, two to six times those of independent corners: fifteen good pairs at 640×480
    # leave 0.9 %, 0.5 % and 2.2 %. A principal point that is off turns the frame, and changes little else.
    max_sigma = 0.01  # of the focal length, and of the baseline
    max_centre_sigma = 0.03  # of the image's width
    max_held_out = 0.0015  # of the image's width
    max_turned_rad = np.radians(45.0)  # more, and a camera lies on its side
    max_hand_error_m = 0.0015  # of a baseline measured with a ruler
    usual_focal = 0.9  # share of the image's width: focal length of a typical webcam, used before calibration
    tilt_deg, tilted_each_way = 15.0, 2  # of the views that are advised
    near, far = 0.55, 0.40  # extent of the board as a share of the image
    still_px = 1.0  # between two frames; the median of all corners
    # A view is new if its corners differ by this share of the image's width from all others, or its tilt by this angle.
    new_share, new_tilt_deg = 0.06, 10.0
