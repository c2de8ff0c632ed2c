"""Calibration of the arm from recordings, latency, comparison, plausibility; the cameras': `vision/calibration`."""
