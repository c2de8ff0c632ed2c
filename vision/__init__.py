"""Marker position in: a coloured ball in rectified stereo images, to a point with covariance.

Nothing is imported here: the configuration is read by commands that must start without OpenCV.
"""
