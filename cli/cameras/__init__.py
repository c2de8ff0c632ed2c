"""Calibrate cameras, and show their images."""
