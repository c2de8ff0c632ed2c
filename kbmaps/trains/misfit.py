"""Errors that no tensor train can follow: of joint readings and compliance, and of a distorting instrument."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from kbmaps.arrays import FloatArray
from kbmaps.maps.basis import JointBasis
from kbmaps.trains.train import TensorTrain

# Candidate standard deviations: of a joint's errors [rad], or in prismatic joints and 1 m away [m].
_STDS = np.geomspace(1e-5, 1e-1, 17)
_SWEEPS = 2
_ROUNDING = 1e-10
# Minimum of twice the gain in log evidence for a kind of errors; one arm in twelve reaches it by chance.
_TELLING = 2.0


def misfit_directions(train: TensorTrain, q: FloatArray) -> FloatArray:
    """Return the effect of joint and instrument errors on the marker (n, 3, 5 d + 18) at q (n, d).

    In m/rad, or m/m; q is not checked. A joint's error is a second harmonic of its reading, or proportional to the
    moment of a force on the marker along each axis of the measurement frame. The first models eccentric encoders, gears
    and other periodic errors (a train has the constant and the first harmonic), the second elastic joints. The
    instrument's error is any quadratic function of the position, as of lenses (a train follows linear ones).
    """
    slopes = train.jacobian(q)
    phases = _phases(train.bases, q)
    errors = [np.cos(phases), np.sin(phases)]
    # Scaled so that at a lever of 1 m they equal a harmonic; likewise the instrument 1 m away.
    errors += [slopes[:, axis] for axis in range(3)]
    x = train.predict(q)
    squares = (x[:, :, None] * x[:, None, :])[:, *np.triu_indices(3)]
    bends = np.einsum("ij,nk->nijk", np.eye(3), squares).reshape(len(q), 3, -1)
    return np.concatenate([*(slopes * error[:, None] for error in errors), bends], axis=2)


def misfit_sizes(joints: int) -> tuple[int, int, int]:
    """Return the number of directions for joints' harmonics, joints under load, and the instrument."""
    return 2 * joints, 3 * joints, 18


def likely_misfit(
    directions: FloatArray, absorbed: FloatArray, residuals: FloatArray, sizes: tuple[int, ...]
) -> FloatArray:
    """Return the most likely standard deviation of each group of errors; 0 if the pairs support none.

    With y = J z + G w + e in units of the noise, z ~ N(0, I), w ~ N(0, D²) and z marginalised, the information about w
    is C = Gᵀ (I + J Jᵀ)⁻¹ G, and Gᵀ r of the residuals r at the best z:

        2 log p(D) - 2 log p(0) = rᵀ G D (I + D C D)⁻¹ D Gᵀ r - log |I + D C D|.

    Args:
        directions: G (m, k).
        absorbed: Rᵀ G (p, k), with R Rᵀ = J (JᵀJ + I)⁻¹ Jᵀ.
        residuals: r (m,).
        sizes: of the groups, k in all.
    """
    values, vectors = np.linalg.eigh(directions.T @ directions - absorbed.T @ absorbed)
    # Directions that the cores absorb up to rounding are not determined; without noise, rounding would look
    # significant.
    values = np.maximum(values, _ROUNDING * max(float(values.max(initial=0.0)), 1e-300))
    matrix = (vectors * values) @ vectors.T
    pull = directions.T @ residuals
    stds = np.zeros(len(sizes))
    for _ in range(_SWEEPS):
        for group in range(len(sizes)):
            trials = np.tile(stds, (len(_STDS) + 1, 1))
            trials[:, group] = 0.0, *_STDS
            gains = np.array([_gain(matrix, pull, np.repeat(trial, sizes)) for trial in trials])
            gains[0] += _TELLING
            stds = trials[int(gains.argmax())]
    return stds


def _gain(matrix: FloatArray, pull: FloatArray, spread: FloatArray) -> float:
    some = np.flatnonzero(spread)
    scaled = spread[some] * pull[some]
    factor = np.linalg.cholesky(np.eye(len(some)) + matrix[np.ix_(some, some)] * np.outer(spread[some], spread[some]))
    return float(np.square(np.linalg.solve(factor, scaled)).sum() - 2.0 * np.log(np.diag(factor)).sum())


def _phases(bases: Sequence[JointBasis], q: FloatArray) -> FloatArray:
    """Return twice the angle of a revolute joint; a prismatic one's stroke counts as a turn."""
    phases = 2.0 * q
    for k, basis in enumerate(bases):
        if basis.is_prismatic:
            start, span = basis.terms.phases
            phases[:, k] = 2.0 * np.pi * (q[:, k] - start) / span
    return phases
