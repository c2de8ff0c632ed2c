"""Marker positions from camera images, and camera calibration.

Nothing is imported here: the configuration is read by commands that must start without OpenCV.
"""
