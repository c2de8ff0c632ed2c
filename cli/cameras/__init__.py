"""Calibrate cameras, and show what they see."""
