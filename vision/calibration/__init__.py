"""Calibration of two cameras' lenses and relative pose from images of a board."""
