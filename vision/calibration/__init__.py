"""Calibration of lenses and of two cameras' relative pose from images of a board; the arm's is in `calibration`."""
