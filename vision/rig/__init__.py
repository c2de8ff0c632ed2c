"""Lenses and the geometry of calibrated cameras.

`common_error` contains the errors that all pairs of a calibrated camera share; `learning/snapshot.py` adds their
variance to each prediction.
"""
