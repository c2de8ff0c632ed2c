"""Lenses and the geometry of calibrated cameras."""
