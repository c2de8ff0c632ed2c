"""Propagation of a calibration's covariance to results computed with it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from bodyschema.interfaces.records import FloatArray

from .stereo_rig import StereoRig

_STEP = 1e-3  # of a parameter's sigma


def covariance_of(rig: StereoRig, figures: Callable[[StereoRig], FloatArray]) -> FloatArray:
    """Return the covariance (m, m) of figures (m,) computed from a rig, to first order."""
    vector, sigma = rig.vector, rig.sigma
    slopes = []
    for k, step in enumerate(_STEP * sigma):
        forward, backward = (
            figures(rig.with_vector(vector + sign * step * np.eye(len(vector))[k])) for sign in (1, -1)
        )
        slopes.append((forward - backward) / (2.0 * step))
    J = np.array(slopes)
    return J.T @ rig.covariance @ J
