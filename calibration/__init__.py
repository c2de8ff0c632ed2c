"""Calibrate the arm from recordings; latency, comparison and plausibility. Cameras are in `vision/calibration`."""
