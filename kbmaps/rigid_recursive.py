"""Learning a rigid chain pair by pair: an iterated extended Kalman filter over its parameters."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Self, cast

import numpy as np
from numpy.typing import ArrayLike

from kbmaps.arrays import FloatArray, frozen, rows, rows_or_vector
from kbmaps.chain import RigidChain
from kbmaps.chain_parameters import SMALL_ANGLE, WIDE, ChainParameters, ChainTolerances
from kbmaps.errors import KBMapsError, ModelFormatError, NonFiniteError, SettingError, ShapeError
from kbmaps.kernels import FilterKernel, filter_kernel
from kbmaps.model import Estimate
from kbmaps.packed import chain_arrays, chain_from_arrays, numbers, pack, unpack
from kbmaps.pairs import checked_pairs
from kbmaps.rigid_learner import RigidLearner

_KIND = "rigid chain, recursive, 1"
# Unit of the marker's place where its tolerance is 0, so that a tool change can loosen it [m].
_TOOL_UNIT = 0.1
_ITERATIONS = 5
# Linearise anew when the curvature of the last step may have moved the marker by this share of the noise.
_SMALL_BEND = 0.1
# Squared Mahalanobis distance of an innovation beyond which a pair counts for less (chi², 3 degrees: 1 in 10,000).
_GATE = 21.0
# The estimate of the noise starts as if it had seen this many coordinates, and forgets those before the last ones.
_NOISE_COORDINATES, _NOISE_MEMORY = 6.0, 900.0
_LEAST_NOISE_M = 1e-6
# A pair is near data where the chain's own uncertainty is at most this many times the noise (in variance).
_SUPPORT_FACTOR = 1.0
_EYE = np.eye(3)


@dataclass(frozen=True, eq=False)
class _Update:
    """A step of the filter (p,), its gains P Jᵀ (p, 3) and the innovation's inverse covariance (3, 3).

    `distance` is the squared Mahalanobis length of the innovation, `bend` how far [m] the step's curvature may have
    moved the marker at most.
    """

    step: FloatArray
    gains: FloatArray
    precision: FloatArray
    variance: float
    distance: float
    bend: float


class RecursiveRigidLearner:
    """Corrects a rigid chain with each pair, at a constant cost (7 joints: 0.2 ms, compiled 8 µs); keeps no pairs.

    The parameters and the prior are those of `RigidLearner`. The filter linearises each pair once, where the chain is
    when the pair comes; the curvature left out is taken for noise, so that early pairs do not make it too sure. That
    works from tolerances as rough drawings have them; where more is open, begin with `continuing` a batch.

    Args:
        nominal: the chain as drawn.
        tolerances: how far the real one may be from it.
        noise: 1-sigma of a coordinate to start from where pairs come without their sigma [m]; it is then estimated.
            Too small a one makes the first pairs count for more than they should.

    Raises:
        SettingError: noise is not positive.

    Example:
        >>> import numpy as np
        >>> from kbmaps import ChainTolerances, RecursiveRigidLearner, RigidChain
        >>> fixed = np.tile(np.eye(4), (3, 1, 1))
        >>> fixed[1:, 0, 3] = 0.3, 0.2  # links [m]
        >>> arm = RigidChain(fixed, axes=[[0, 0, 1], [0, 1, 0]], prismatic=[False, False])
        >>> learner = RecursiveRigidLearner(arm, ChainTolerances(tool=0.1), noise=1e-6)
        >>> learner.learn([0.0, 0.0], [0.5, 0.0, 0.1])  # 100 mm above where it was drawn
        >>> learner.predict([0.0, -np.pi / 2]).round(6)
        array([0.2, 0. , 0.2])
    """

    def __init__(self, nominal: RigidChain, tolerances: ChainTolerances, *, noise: float = 0.01) -> None:
        if not (noise > 0.0 and math.isfinite(noise)):
            raise SettingError(f"noise must be finite and greater than 0 m, got {noise!r}")
        self._parameters = ChainParameters(nominal)
        self._tolerances = tolerances
        std = np.minimum(self._parameters.standard_deviations(tolerances), WIDE)
        tool = np.zeros(self._parameters.size, dtype=np.bool_)
        tool[self._parameters.tool] = True
        self._active = (std > 0.0) | tool
        self._scales = np.where((std == 0.0) & tool, _TOOL_UNIT, std)[self._active]
        self._bends = self._turning()[self._active]
        self._reach = max(float(np.linalg.norm(nominal.fixed[1:, :3, 3], axis=1).sum()) / 2.0, 1e-3)
        self._kernel = self._filter_kernel()
        self._change = np.zeros(self._parameters.size)
        self._covariance: FloatArray = np.diag(np.square(std[self._active] / self._scales))
        self._noise_square = noise**2
        self._noise_coordinates = _NOISE_COORDINATES
        self._pairs = 0

    @classmethod
    def continuing(cls, batch: RigidLearner) -> Self:
        """A learner that goes on from what a batch has found.

        Raises:
            DegenerateDataError: the batch has learnt no pair.
        """
        report = batch.report()
        learner = cls(batch.nominal, batch.tolerances, noise=max(report.noise, _LEAST_NOISE_M))
        active = learner._active
        learner._change = np.array(batch.change)
        learner._covariance = batch.covariance[np.ix_(active, active)] / np.outer(learner._scales, learner._scales)
        learner._noise_coordinates = max(float(np.clip(report.freedom, 0.0, _NOISE_MEMORY)), _NOISE_COORDINATES)
        learner._pairs = batch.pairs
        return learner

    @property
    def joints(self) -> int:
        """Number of joints d."""
        return self.nominal.joints

    @property
    def pairs(self) -> int:
        """How many pairs have been learnt."""
        return self._pairs

    @property
    def nominal(self) -> RigidChain:
        """The chain that learning started from."""
        return self._parameters.reference

    @property
    def chain(self) -> RigidChain:
        """The chain as learnt."""
        return self._parameters.chain(self._change)

    @property
    def noise(self) -> float:
        """Estimated 1-sigma of a coordinate [m] of the pairs that came without theirs."""
        return math.sqrt(self._noise_square)

    @property
    def change(self) -> FloatArray:
        """The parameters (size,) as in `ChainParameters` (a read-only copy)."""
        return frozen(self._change)

    @property
    def covariance(self) -> FloatArray:
        """Covariance (size, size) of the parameters [rad², m²] (a read-only copy)."""
        covariance = np.zeros((self._parameters.size, self._parameters.size))
        covariance[np.ix_(self._active, self._active)] = self._covariance * np.outer(self._scales, self._scales)
        return frozen(covariance)

    def learn(self, q: ArrayLike, x: ArrayLike, sigma: ArrayLike | None = None) -> None:
        """Pairs q (n, d) [rad, m] and x (n, 3) [m], or one, (d,) and (3,), one after the other.

        Args:
            sigma: 1-sigma of the positions [m], () or (n,); None where it is to be estimated.

        Raises:
            ShapeError, NonFiniteError, SettingError (a sigma that is not positive): nothing has changed.
        """
        angles, positions, sigmas = checked_pairs(q, x, sigma, self.joints)
        if self._kernel is None:
            for k in range(len(angles)):
                self._learn_one(angles[k : k + 1], positions[k], float(sigmas[k]))
        else:
            self._learn_compiled(self._kernel, angles, positions, sigmas)
        self._pairs += len(angles)

    def tool_changed(self, tolerance: float) -> None:
        """Tells that the marker was moved, by `tolerance` (1-sigma of each component [m]); the arm stays known.

        Raises:
            SettingError: the tolerance is not positive.
        """
        if not (tolerance > 0.0 and math.isfinite(tolerance)):
            raise SettingError(f"tolerance must be finite and greater than 0 m, got {tolerance!r}")
        tool = slice(len(self._scales) - 3, None)
        diagonal = np.einsum("kk->k", self._covariance)
        diagonal[tool] += np.square(tolerance / self._scales[tool])

    def predict(self, q: ArrayLike) -> FloatArray:
        """Positions (n, 3) [m] at q (n, d), or (3,) at q (d,).

        Raises:
            ShapeError, NonFiniteError
        """
        return self._parameters.positions(self._change, rows_or_vector("q", q, self.joints))

    def estimate(self, q: ArrayLike) -> Estimate:
        """Positions at q (n, d), their 1-sigma per axis against the truth, and whether data was there.

        Raises:
            ShapeError, NonFiniteError
        """
        x, jacobian = self._linearised(self._change, rows("q", q, self.joints))
        variance = np.einsum("nip,pr,nir->ni", jacobian, self._covariance, jacobian, optimize=True)
        variance = np.maximum(variance, 0.0)
        inside = (variance.mean(axis=1) <= _SUPPORT_FACTOR * self._noise_square) & (self._pairs > 0)
        return Estimate(x, np.sqrt(variance), inside)

    def to_bytes(self) -> bytes:
        """The learner as it is; `from_bytes` learns on to the last bit as this one would."""
        settings = asdict(self._tolerances) | {
            "noise": self.noise,
            "noise_coordinates": self._noise_coordinates,
            "pairs": self._pairs,
        }
        arrays = chain_arrays(self.nominal) | {
            "change": self._change,
            "covariance": self._covariance,
            "noise_square": np.array([self._noise_square]),
        }
        return pack(_KIND, settings, arrays)

    @classmethod
    def from_bytes(cls, data: bytes) -> Self:
        """The learner in `data`. Raises ModelFormatError: it is none of this kind, or damaged."""
        fields, arrays = unpack(data, _KIND)
        settings = numbers(fields)
        try:
            pairs, coordinates = settings.pop("pairs"), settings.pop("noise_coordinates")
            noise = settings.pop("noise")
            chain = chain_from_arrays(arrays)
            learner = cls(chain, ChainTolerances(**settings), noise=noise)
            learner._restore(arrays["change"], arrays["covariance"])
            learner._noise_square = float(arrays["noise_square"][0])
        except (KeyError, IndexError, TypeError, KBMapsError) as error:
            raise ModelFormatError(f"the bytes do not describe a recursive rigid learner: {error}") from error
        learner._pairs, learner._noise_coordinates = int(pairs), coordinates
        return learner

    def _restore(self, change: FloatArray, covariance: FloatArray) -> None:
        for name, stored, present in (
            ("change", change, self._change),
            ("covariance", covariance, self._covariance),
        ):
            if stored.shape != present.shape:
                raise ShapeError(name, str(present.shape), stored.shape)
            if not np.isfinite(stored).all():
                raise NonFiniteError(name)
        self._change, self._covariance = np.array(change), np.array(covariance)

    def _filter_kernel(self) -> FilterKernel | None:
        scales = np.zeros(self._parameters.size)
        scales[self._active] = self._scales
        constants = [_ITERATIONS, _SMALL_BEND, _GATE, _NOISE_MEMORY, _LEAST_NOISE_M**2, SMALL_ANGLE, self._reach]
        return filter_kernel(*self._parameters.tables, scales, self._turning(), np.array(constants))

    def _learn_compiled(self, kernel: FilterKernel, q: FloatArray, x: FloatArray, sigma: FloatArray) -> None:
        """What `_learn_one` does with each pair."""
        taken, self._noise_square, self._noise_coordinates = kernel.learn(
            self._change,
            self._covariance,
            np.ascontiguousarray(q),
            np.ascontiguousarray(x),
            np.ascontiguousarray(sigma),
            self._noise_square,
            self._noise_coordinates,
        )
        if taken < len(q):
            raise np.linalg.LinAlgError("Singular matrix")

    def _turning(self) -> FloatArray:
        """1 for the parameters (size,) that are angles and so bend the marker's way, 0 for lengths."""
        bends = np.zeros(self._parameters.size)
        bends[self._parameters.base_turn] = bends[self._parameters.tilts] = 1.0
        bends[self._parameters.zeros] = ~self.nominal.prismatic
        return bends

    def _linearised(self, change: FloatArray, q: FloatArray) -> tuple[FloatArray, FloatArray]:
        x, jacobian = self._parameters.linearised(change, q)
        return x, jacobian[:, :, self._active] * self._scales

    def _learn_one(self, q: FloatArray, x: FloatArray, sigma: float) -> None:
        """An iterated update (Bell and Cathey 1993): the gain is that of the point it leads to."""
        told = not math.isnan(sigma)
        noise_square = sigma**2 if told else self._noise_square
        update = self._update(self._change, np.zeros(len(self._scales)), q, x, noise_square, 1.0)
        # An outlier gets the weight with which it would be at the gate (Huber's influence).
        distance = min(update.distance, _GATE)
        weight = distance / update.distance if distance > 0.0 else 1.0
        if weight < 1.0:
            update = self._update(self._change, np.zeros(len(self._scales)), q, x, noise_square, weight)
        for _ in range(_ITERATIONS):
            if update.bend <= _SMALL_BEND * math.sqrt(update.variance):
                break
            update = self._update(self._moved(update.step), update.step, q, x, noise_square, weight)
        self._change = self._moved(update.step)
        self._covariance -= update.gains @ update.precision @ update.gains.T
        if not told:
            self._reestimate(distance, update.precision)

    def _update(
        self, change: FloatArray, present: FloatArray, q: FloatArray, x: FloatArray, noise_square: float, weight: float
    ) -> _Update:
        """The step (p,) from where the filter is, with the measurement linearised at the step `present` (p,)."""
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
        change = self._change.copy()
        change[self._active] += self._scales * step
        return change

    def _curvature(self, jacobian: FloatArray) -> float:
        """Variance [m²] that the linearisation leaves out.

        An uncertainty s of the position from angles alone, at the reach L, bends the marker's way by s² / (2 L).
        """
        turning = jacobian * self._bends
        square = float(np.vdot(turning @ self._covariance, turning)) / 3.0
        return 0.25 * (square / self._reach) ** 2

    def _reestimate(self, distance: float, precision: FloatArray) -> None:
        """Noise² from the squared Mahalanobis distance of an innovation, which is 3 on average when it is right.

        Fisher scoring: an innovation tells of the noise by the share that noise has in its variance.
        """
        share = self._noise_square * float(np.trace(precision)) / 3.0
        total = self._noise_coordinates + 3.0 * share**2
        square = self._noise_square * (1.0 + share * (distance - 3.0) / total)
        self._noise_square = max(square, _LEAST_NOISE_M**2)
        self._noise_coordinates = min(total, _NOISE_MEMORY)
