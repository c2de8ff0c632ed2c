"""Stereo images rendered in a separate process."""
