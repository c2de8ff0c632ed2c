"""Mechanisms between an encoder's reading and a joint's true position.

The *shaft* is the joint's position as its motor drives it. The encoder reads the shaft; the output may lag behind it.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import root_scalar

from .arrays import FloatArray
from .motion import FINE


def off_centre_ring(shaft_rad: FloatArray, ex: float, ey: float) -> FloatArray:
    """Return the angle [rad] read from a magnet ring displaced by (ex, ey), in parts of the ring's radius."""
    field = np.arctan2(np.sin(shaft_rad) + ey, np.cos(shaft_rad) + ex)
    return shaft_rad + _wrapped(field - shaft_rad)


def biased_poles(shaft_rad: FloatArray, poles: float, bias_sine: float, bias_cosine: float) -> FloatArray:
    """Return the angle [rad] read from `poles` pole pairs per turn with a bias of the sine and cosine signals."""
    electrical = poles * shaft_rad
    read = np.arctan2(np.sin(electrical) + bias_sine, np.cos(electrical) + bias_cosine)
    return shaft_rad + _wrapped(read - electrical) / poles


def play(shaft: FloatArray, width: float) -> FloatArray:
    """Return the output of a gear with backlash `width` along a path (f,): it stays until a flank moves it."""
    half, place = 0.5 * width, float(shaft[0])
    output = np.empty_like(shaft)
    for index, pushed in enumerate(shaft.tolist()):
        place = min(max(place, pushed - half), pushed + half)
        output[index] = place
    return output


def lagging(t: FloatArray, shaft: FloatArray, tau_s: float) -> FloatArray:
    """Return the output (f,) of a first-order lag dy/dt = (shaft − y)/τ along a path.

    The result is exact for a shaft that moves linearly between the times.
    """
    lasts = np.diff(t)
    keeps = np.exp(-lasts / tau_s)
    slope = np.diff(shaft) / lasts
    # With the shaft s + m·h the lag e = y − shaft obeys de/dt = −e/τ − m, so e -> keeps·e − m·τ·(1 − keeps).
    driven = -slope * tau_s * (1.0 - keeps)
    behind, error = np.empty_like(shaft), 0.0
    behind[0] = 0.0
    for index, (keep, push) in enumerate(zip(keeps.tolist(), driven.tolist(), strict=True), 1):
        error = keep * error + push
        behind[index] = error
    return shaft + behind


def left_of_move(tau_s: float, move_s: float, rest_s: float) -> float:
    """Return the part of a smooth move of `move_s` that a lagging output still lacks `rest_s` after its end.

    The move is as a `Motion` has it: straight between `FINE` instants.
    """
    h = np.linspace(0.0, 1.0, FINE + 1)
    t = np.append(h * move_s, move_s + rest_s)
    return float(1.0 - lagging(t, np.append(h * h * (3.0 - 2.0 * h), 1.0), tau_s)[-1])


def lag_that_leaves(left: float, move_s: float, rest_s: float) -> float:
    """Return the time constant [s] of a lag that leaves this part of a move."""

    def excess(log_tau: float) -> float:
        return left_of_move(float(np.exp(log_tau)), move_s, rest_s) - left

    bracket = (np.log(0.02 * rest_s), np.log(100.0 * (move_s + rest_s)))
    return float(np.exp(root_scalar(excess, bracket=bracket, xtol=1e-10).root))


def wandering(t: FloatArray, normals: FloatArray, interval_s: float) -> FloatArray:
    """Return a slow random walk with smooth turns: unit steps `normals` every `interval_s`, at the times `t`, RMS 1."""
    corners = np.cumsum(normals)
    corners = (corners - corners.mean()) / corners.std()
    phase = np.clip(t / interval_s, 0.0, len(corners) - 1.001)
    left = phase.astype(int)
    blend = phase - left
    blend = blend * blend * (3.0 - 2.0 * blend)
    return corners[left] + blend * (corners[left + 1] - corners[left])


def _wrapped(angle_rad: FloatArray) -> FloatArray:
    return np.remainder(angle_rad + np.pi, 2.0 * np.pi) - np.pi
