"""An iterated extended Kalman filter over the parameters of a rigid chain."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import cast

import numpy as np
from numpy.typing import ArrayLike

from kbmaps.arrays import FloatArray
from kbmaps.chains.belief import ChainBelief
from kbmaps.chains.parameters import WIDE, ChainParameters, ChainTolerances
from kbmaps.errors import NonFiniteError, SettingError, ShapeError
from kbmaps.maps.code_path import FilterKernel, filter_kernel
from kbmaps.robust import RobustSettings
from kbmaps.rotations import RotationSettings

# Squared Mahalanobis distance of an innovation beyond which a pair is down-weighted.
_GATE = RobustSettings.outlier_sigmas * RobustSettings.outlier_sigmas
_EYE = np.eye(3)


class FilterSettings:
    tool_unit = 0.1  # scale of the marker's position where its tolerance is 0, so that a tool change can loosen it [m]
    # Relinearise, at most this often, while the last step's curvature may move the marker by this share of the noise.
    iterations, small_bend = 5, 0.1
    # The noise estimate starts with the weight of this many coordinates, and forgets all but this many of the last
    # ones.
    noise_coordinates, noise_memory = 6.0, 900.0
    min_noise_m = 1e-6  # no camera is better, and the formulas need a positive value


@dataclass(frozen=True, eq=False)
class _Update:
    """Step of the filter (p,), its gains P Jᵀ (p, 3) and the innovation's inverse covariance (3, 3).

    `distance` is the squared Mahalanobis length of the innovation. `bend` bounds how far [m] the step's curvature may
    have moved the marker.
    """

    step: FloatArray
    gains: FloatArray
    precision: FloatArray
    variance: float
    distance: float
    bend: float


class RigidFilter:
    """Sequential estimator of a chain's change and its covariance, at a constant cost per pair.

    Each pair is linearised once: at the last fit, or, before any fit, at the current estimate. The curvature left out
    counts as noise, so that early pairs do not make the estimate overconfident.
    """

    STORED = ("change", "covariance", "noise", "origin")

    def __init__(self, parameters: ChainParameters, tolerances: ChainTolerances, noise: float) -> None:
        self.parameters = parameters
        std = np.minimum(parameters.standard_deviations(tolerances), WIDE)
        tool = np.zeros(parameters.size, dtype=np.bool_)
        tool[parameters.tool] = True
        self._active = (std > 0.0) | tool
        self._scales = np.where((std == 0.0) & tool, FilterSettings.tool_unit, std)[self._active]
        self._bends = parameters.turning.astype(np.float64)[self._active]
        self._reach = parameters.reach
        self._kernel = self._filter_kernel()
        self.change = np.zeros(parameters.size)  # the parameters (size,) as in `ChainParameters`
        # linearisation point (size,); None: at `change`. Many directions of a chain have no effect on positions, and
        # others hardly any. With one origin for all pairs, these directions are the same for each pair. With several,
        # pairs seem to carry information about them, and the chain drifts along them (Huang, Mourikis and Roumeliotis
        # 2010)
        self.origin: FloatArray | None = None
        self._covariance: FloatArray = np.diag(np.square(std[self._active] / self._scales))
        # the estimated variance [m²] of a coordinate of the pairs that came without their sigma
        self.noise_square = noise**2
        self.noise_coordinates = FilterSettings.noise_coordinates  # number of coordinates that this estimate rests on

    @property
    def covariance(self) -> FloatArray:
        """Covariance (size, size) of the parameters [rad², m²]."""
        covariance = np.zeros((self.parameters.size, self.parameters.size))
        covariance[np.ix_(self._active, self._active)] = self._covariance * np.outer(self._scales, self._scales)
        return covariance

    def learn(self, q: FloatArray, x: FloatArray, sigma: FloatArray) -> None:
        """Learn checked pairs q (n, d), x (n, 3) and sigma (n,), NaN to estimate it."""
        if self._kernel is not None:
            self._learn_compiled(self._kernel, q, x, sigma)
            return
        for k in range(len(q)):
            self._learn_one(q[k : k + 1], x[k], float(sigma[k]))

    def learn_plain(self, q: ArrayLike, x: ArrayLike, sigma: ArrayLike | None, row: FloatArray) -> bool:
        """Learn one pair and write q, x and sigma to `row` (d + 4), if the kernel can use them unconverted.

        Returns False, and changes nothing, if there is no kernel or the input needs conversion or is invalid.
        """
        if self._kernel is None:
            return False
        noise = self._kernel.learn_one(
            self.change, self._covariance, row, q, x, sigma, self.origin, self.noise_square, self.noise_coordinates
        )
        if noise is None:
            return False
        self.noise_square, self.noise_coordinates = noise
        return True

    def go_on_from(self, belief: ChainBelief, *, fitted: bool) -> None:
        """Replace the estimate by a posterior of the same chain.

        Args:
            belief: the posterior that replaces the information of all pairs so far.
            fitted: True if its mean is the linearisation point of those pairs, and near enough for later ones.
        """
        active = self._active
        self.change = np.array(belief.mean)
        self.origin = np.array(belief.mean) if fitted else None
        self._covariance = belief.covariance[np.ix_(active, active)] / np.outer(self._scales, self._scales)

    def with_variance(self, q: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return positions at q (n, d) and the first-order variance of each coordinate, both (n, 3) [m, m²]."""
        x, jacobian = self._linearised(self.change, q)
        variance = np.einsum("nip,pr,nir->ni", jacobian, self._covariance, jacobian, optimize=True)
        return x, np.maximum(variance, 0.0)

    def arrays(self) -> dict[str, FloatArray]:
        """Return the state as arrays for `kbmaps.packed`."""
        noise = np.array([self.noise_square, self.noise_coordinates])
        origin = np.empty(0) if self.origin is None else self.origin
        return {"change": self.change, "covariance": self._covariance, "noise": noise, "origin": origin}

    def restore(self, arrays: Mapping[str, FloatArray]) -> None:
        """Restore the state from `arrays`.

        Raises:
            KeyError, ShapeError, NonFiniteError, SettingError: they are not those of a state.
        """
        shapes = {name: array.shape for name, array in self.arrays().items()}
        linearised = arrays["origin"].size > 0
        shapes["origin"] = self.change.shape if linearised else (0,)
        for name, shape in shapes.items():
            if arrays[name].shape != shape:
                raise ShapeError(name, str(shape), arrays[name].shape)
            if not np.isfinite(arrays[name]).all():
                raise NonFiniteError(name)
        if not (arrays["noise"] > 0.0).all():
            raise SettingError("the noise must be greater than 0 m")
        self.change, self._covariance = np.array(arrays["change"]), np.array(arrays["covariance"])
        self.origin = np.array(arrays["origin"]) if linearised else None
        self.noise_square, self.noise_coordinates = (float(number) for number in arrays["noise"])

    def _filter_kernel(self) -> FilterKernel | None:
        scales = np.zeros(self.parameters.size)
        scales[self._active] = self._scales
        of_steps = [FilterSettings.iterations, FilterSettings.small_bend, _GATE]
        of_noise = [FilterSettings.noise_memory, FilterSettings.min_noise_m**2]
        constants = [*of_steps, *of_noise, RotationSettings.small_rad, self._reach]
        return filter_kernel(
            *self.parameters.tables, scales, self.parameters.turning.astype(np.float64), np.array(constants)
        )

    def _learn_compiled(self, kernel: FilterKernel, q: FloatArray, x: FloatArray, sigma: FloatArray) -> None:
        taken, self.noise_square, self.noise_coordinates = kernel.learn(
            self.change,
            self._covariance,
            np.ascontiguousarray(q),
            np.ascontiguousarray(x),
            np.ascontiguousarray(sigma),
            self.origin,
            self.noise_square,
            self.noise_coordinates,
        )
        if taken < len(q):
            raise np.linalg.LinAlgError("Singular matrix")

    def _linearised(self, change: FloatArray, q: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return positions (n, 3) of the chain at `change`, and their derivatives (n, 3, p) at the origin."""
        x, jacobian = self.parameters.linearised(change if self.origin is None else self.origin, q)
        if self.origin is not None:
            x = self.parameters.positions(change, q)
        return x, jacobian[:, :, self._active] * self._scales

    def _learn_one(self, q: FloatArray, x: FloatArray, sigma: float) -> None:
        """Update with one pair, iterated (Bell and Cathey 1993): the gain is evaluated at the resulting point."""
        told = not math.isnan(sigma)
        noise_square = sigma**2 if told else self.noise_square
        update = self._update(self.change, np.zeros(len(self._scales)), q, x, noise_square, 1.0)
        # An outlier gets the weight that places it at the gate (Huber's influence).
        distance = min(update.distance, _GATE)
        weight = distance / update.distance if distance > 0.0 else 1.0
        if weight < 1.0:
            update = self._update(self.change, np.zeros(len(self._scales)), q, x, noise_square, weight)
        for _ in range(FilterSettings.iterations):
            if update.bend <= FilterSettings.small_bend * math.sqrt(update.variance):
                break
            update = self._update(self._moved(update.step), update.step, q, x, noise_square, weight)
        self.change = self._moved(update.step)
        self._covariance -= update.gains @ update.precision @ update.gains.T
        if not told:
            self._reestimate(distance, update.precision)

    def _update(
        self, change: FloatArray, present: FloatArray, q: FloatArray, x: FloatArray, noise_square: float, weight: float
    ) -> _Update:
        """Return the step (p,) from the filter's state, with the measurement linearised at the step `present` (p,)."""
        positions, jacobians = self._linearised(change, q)
        jacobian, innovation = jacobians[0], x - positions[0] + jacobians[0] @ present
        gains = self._covariance @ jacobian.T
        variance = noise_square + self._curvature(jacobian)
        precision = cast(FloatArray, np.linalg.inv(jacobian @ gains + _EYE * (variance / weight)))
        weighted = precision @ innovation
        step = gains @ weighted
        moved = step - present
        turn = float(np.linalg.norm(moved * self._scales * self._bends))
        bend = turn * float(np.linalg.norm(jacobian @ moved))
        return _Update(step, gains, precision, variance, float(innovation @ weighted), bend)

    def _moved(self, step: FloatArray) -> FloatArray:
        change = self.change.copy()
        change[self._active] += self._scales * step
        return change

    def _curvature(self, jacobian: FloatArray) -> float:
        """Return the variance [m²] that the linearisation leaves out.

        An uncertainty s of the position from angles alone, at the reach L, curves the marker's path by s² / (2 L).
        """
        turning = jacobian * self._bends
        square = float(np.vdot(turning @ self._covariance, turning)) / 3.0
        return 0.25 * (square / self._reach) ** 2

    def _reestimate(self, distance: float, precision: FloatArray) -> None:
        """Update noise² from the squared Mahalanobis distance of an innovation.

        The distance is 3 on average if noise² is right. Fisher scoring: an innovation carries information about the
        noise by the noise's share of its variance.
        """
        share = self.noise_square * float(np.trace(precision)) / 3.0
        total = self.noise_coordinates + 3.0 * share**2
        square = self.noise_square * (1.0 + share * (distance - 3.0) / total)
        self.noise_square = max(square, FilterSettings.min_noise_m**2)
        self.noise_coordinates = min(total, FilterSettings.noise_memory)
