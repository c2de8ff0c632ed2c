"""Posterior of a tensor train, including errors that it cannot follow."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from kbmaps.arrays import FloatArray, rows
from kbmaps.maps.basis import JointBasis
from kbmaps.maps.stack import BasisStack
from kbmaps.model import widest
from kbmaps.trains.core_prior import CORE_NUMBERS, CorePrior
from kbmaps.trains.fit import whitened_jacobian
from kbmaps.trains.train import TensorTrain


class _Settings:
    sweeps: int = 2
    rounding: float = 1e-10
    # Minimum of twice the gain in log evidence for a kind of errors; one arm in twelve reaches it by chance.
    telling: float = 2.0
    batch_rows: int = 512
    frame_error: float = 0.05  # assumed error of the last frame's axes, as a share of a marker's displacement
    # Candidate standard deviations: of a joint's errors [rad], or in prismatic joints and 1 m away [m].
    stds = np.geomspace(1e-5, 1e-1, 17)


def misfit_directions(train: TensorTrain, q: FloatArray) -> FloatArray:
    """Return the effect of joint and instrument errors on the marker (n, 3, 5 d + 18) at q (n, d).

    In m/rad, or m/m; q is not checked. A joint's error is a second harmonic of its reading, or proportional to the
    moment of a force on the marker along each axis of the measurement frame. The first models eccentric encoders, gears
    and other periodic errors (a train has the constant and the first harmonic), the second elastic joints. The
    instrument's error is any quadratic function of the position, such as that of lenses (a train follows linear ones).
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
        sizes: numbers of directions of the groups, k in all.
    """
    values, vectors = np.linalg.eigh(directions.T @ directions - absorbed.T @ absorbed)
    # Directions that the cores absorb up to rounding are not determined; without noise, rounding would look
    # significant.
    values = np.maximum(values, _Settings.rounding * max(float(values.max(initial=0.0)), 1e-300))
    matrix = (vectors * values) @ vectors.T
    pull = directions.T @ residuals
    stds = np.zeros(len(sizes))
    for _ in range(_Settings.sweeps):
        for group in range(len(sizes)):
            trials = np.tile(stds, (len(_Settings.stds) + 1, 1))
            trials[:, group] = 0.0, *_Settings.stds
            gains = np.array([_gain(matrix, pull, np.repeat(trial, sizes)) for trial in trials])
            gains[0] += _Settings.telling
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


class TensorPosterior:
    """Gauss-Newton posterior of a train's cores. A `kbmaps.planning.design.Posterior`.

    Args:
        train: the most likely train.
        prior: prior of its cores.
        information: JᵀJ (36 d, 36 d) of the pairs by whitened cores; None before any pair.
        noise: 1-sigma of each coordinate of a further pair [m].
    """

    floor = 0.0

    def __init__(
        self, train: TensorTrain, prior: CorePrior, information: FloatArray | None, *, noise: float = 0.0
    ) -> None:
        self._train, self._prior, self.information = train, prior, information
        self._stack = BasisStack(train.bases)
        self.noise = noise
        self._sizes = misfit_sizes(prior.joints)
        size = CORE_NUMBERS * prior.joints
        self._pending_residuals: tuple[FloatArray, FloatArray, FloatArray] | None = None
        self._learnt: FloatArray | None = None
        self._widest = widest(np.empty((0, 3)))
        self._misfit, self._absorbed = np.zeros(len(self._sizes)), np.zeros((size, sum(self._sizes)))

    def set_residuals(self, q: FloatArray, residuals: FloatArray, std: FloatArray) -> None:
        """Set the residuals from which errors that the train does not follow are estimated, on demand.

        Args:
            q: configurations (n, d) of the pairs that the fit used.
            residuals: residuals (n, 3) [m] of these pairs.
            std: standard deviation of a coordinate of each (n,) [m], as in `information`.
        """
        self._pending_residuals, self._learnt = (q, residuals, std), q

    @property
    def misfit(self) -> FloatArray:
        """Standard deviations (3,) [rad, m] of errors that no train follows; 0 if the pairs support none."""
        self._estimate_misfit()
        return self._misfit

    @property
    def absorbed(self) -> FloatArray:
        """Part of such errors that the cores absorb (36 d, 5 d + 18)."""
        self._estimate_misfit()
        return self._absorbed

    @property
    def widest(self) -> float:
        """Greatest variance of a position among the pairs that the fit used [m²] (`kbmaps.model.widest`)."""
        if self._learnt is not None:
            self._widest, self._learnt = widest(self.variance(self._learnt)), None
        return self._widest

    def _estimate_misfit(self) -> None:
        if self._pending_residuals is None:
            return
        q, residuals, std = self._pending_residuals
        scale = np.repeat(std, 3)[:, None]
        directions = misfit_directions(self._train, q).reshape(len(scale), -1) / scale
        absorbed = (self._linear_roots(q).reshape(len(scale), -1) / scale).T @ directions
        self.take(likely_misfit(directions, absorbed, residuals.ravel() / scale[:, 0], self._sizes), absorbed)

    def take(self, misfit: FloatArray, absorbed: FloatArray) -> None:
        """Set the standard deviations of the errors (3,) [rad, m], and the part that the cores absorb.

        Args:
            misfit: standard deviations (3,) [rad, m].
            absorbed: part of the errors that the cores absorb (36 d, 5 d + 18).
        """
        self._misfit, self._absorbed, self._pending_residuals = misfit, absorbed, None

    def restore(self, misfit: FloatArray, absorbed: FloatArray, widest: float) -> None:
        """Restore `misfit`, `absorbed` and `widest` of a stored posterior."""
        self.take(misfit, absorbed)
        self._widest = widest

    @cached_property
    def _root(self) -> FloatArray:
        """Root of the cores' covariance (36 d, 36 d)."""
        return np.eye(CORE_NUMBERS * self.joints) if self.information is None else inverse_roots(self.information)

    @property
    def joints(self) -> int:
        """Number of joints d."""
        return self._prior.joints

    def roots(self, q: ArrayLike) -> FloatArray:
        """Return matrices R (n, 3, p) [m] at q (n, d): R_i R_jᵀ is the covariance of the positions at q_i and q_j."""
        angles = rows("q", q, self.joints)
        linear = self._linear_roots(angles)
        if not self.misfit.any():
            return linear
        left = misfit_directions(self._train, angles) - linear @ self.absorbed
        return np.concatenate([linear, np.repeat(self.misfit, self._sizes) * left], axis=2)

    def variance(self, q: FloatArray) -> FloatArray:
        """Return the variance (n, 3) [m²] of each coordinate at q (n, d)."""
        variance = np.empty((len(q), 3))
        for start in range(0, len(q), _Settings.batch_rows):
            part = slice(start, start + _Settings.batch_rows)
            variance[part] = np.square(self.roots(q[part])).sum(axis=2)
        return variance

    def with_other_tool(self, tolerance: float) -> CorePrior:
        """Return each core's posterior with the others fixed; the last is as free as a displaced marker makes it.

        Args:
            tolerance: 1-sigma of each component of the displacement [m].
        """
        cores, spread = self._train.cores.reshape(self.joints, CORE_NUMBERS), self._prior.spread
        if self.information is not None:
            blocks = range(0, CORE_NUMBERS * self.joints, CORE_NUMBERS)
            told = np.stack([self.information[k : k + CORE_NUMBERS, k : k + CORE_NUMBERS] for k in blocks])
            spread = spread @ inverse_roots(told)
        spread = spread.copy()
        moves = _marker_moves(cores[-1].reshape(3, 3, 4), tolerance)
        values, vectors = np.linalg.eigh(spread[-1] @ spread[-1].T + moves @ moves.T)
        spread[-1] = vectors * np.sqrt(np.maximum(values, 0.0))
        return CorePrior(cores, spread)

    def _linear_roots(self, q: FloatArray) -> FloatArray:
        jacobian = whitened_jacobian(self._stack.joint_weights(q), self._train.maps(q), self._prior)
        return (jacobian @ self._root).reshape(len(q), 3, -1)


def inverse_roots(information: FloatArray) -> FloatArray:
    """Return square roots of (H + I)⁻¹ (..., m, m) for H (..., m, m), positive semidefinite up to rounding."""
    values, vectors = np.linalg.eigh(information)
    roots: FloatArray = vectors / np.sqrt(1.0 + np.maximum(values, 0.0))[..., None, :]
    return roots


def _marker_moves(last_core: FloatArray, std: float) -> FloatArray:
    """Return changes (36, moves) of the last core when the marker moves by `std` [m] each way."""
    free = np.diag(np.tile([0.0, 0.0, 0.0, std], 9))
    if not last_core[:, :, :3].any():
        return free
    along = np.zeros((3, 3, 4, 3))
    along[:, :, 3, :] = std * last_core[:, :, :3]
    return np.column_stack([along.reshape(CORE_NUMBERS, 3), _Settings.frame_error * free])
