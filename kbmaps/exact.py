"""Exact least squares: the best control points for all pairs so far. Ulbrich et al. 2009, eqs. (16)-(18)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from kbmaps import lapack
from kbmaps.arrays import FloatArray, rows_or_vector
from kbmaps.basis import JointBasis
from kbmaps.errors import BasisError, NonFiniteError, SettingError, ShapeError
from kbmaps.evidence import most_evident
from kbmaps.factor import RowFactor, ShiftedGram
from kbmaps.kbmap import POSE_OUTPUTS, POSITION_OUTPUTS, KBMap
from kbmaps.memory import check_forgetting
from kbmaps.stack import BasisStack
from kbmaps.targets import pose_targets

_BLOCK = 128
# Below this reciprocal condition number a triangular solve would return rounding errors.
_SMALLEST_RCOND = 1e-13
# Relative to the trace of the Gram matrix: just enough to keep its Cholesky factorisation alive.
_VANISHING_RIDGE = 1e-13
_REFINEMENTS = 30
# Evidence: limits of the search for lambda, relative to the mean diagonal of the Gram matrix.
_SEARCH_LIMITS = (1e-12, 1e6)
_FIRST_PRECISION = 1e-2
# Variances below (1 pm)² are rounding.
_VARIANCE_FLOOR = 1e-24


@dataclass(frozen=True)
class ExactSolution:
    """A fitted map and what the fit says about it.

    Attributes:
        map: in the bases of the prior that the learner was given.
        noise_std: estimated noise of one coordinate at weight 1 [m]; None where the data do not tell.
        orientation_noise_std: the same of one entry of the rotation matrices; None also where none were learnt.
        prior_precision: λ = (noise_std / spread of the prior's coefficients)²; 0 for the unregularised solution.
        log_evidence: log marginal likelihood of all that was learnt at λ; None for the unregularised solution.
        residual_rms: weighted RMS distance between the map's positions and those it was fitted to [m].
    """

    map: KBMap
    noise_std: float | None
    prior_precision: float
    log_evidence: float | None
    residual_rms: float
    orientation_noise_std: float | None = None

    @property
    def prior_std(self) -> float | None:
        """Standard deviation of the coefficients around the prior [m]; None for the unregularised solution.

        Times `SupportSet.spread` (in the learner's bases) it is the 1-sigma of a predicted coordinate.
        """
        if self.noise_std is None or self.prior_precision == 0.0:
            return None
        return self.noise_std / math.sqrt(self.prior_precision)


@dataclass(frozen=True)
class _Fit:
    """One λ: the multipliers (k, outputs), noise variances of positions and of orientations, and evidence."""

    multipliers: FloatArray
    variances: list[float]
    log_evidence: float


class ExactLearner:
    """Collects pairs at a bounded cost and memory, and solves for the map when asked.

    The pairs are kept as the rows of `RowFactor`; the prior is no part of them, so it may change (`rebase`).
    With m = 3^d control points the memory is 8 m² bytes, and up to 24 m² while solving (38 and 115 MB at d = 7).
    The pair that makes them as many as the control points costs one factorisation (about 0.7 s at d = 7), every later
    one its share of a block.

    Args:
        prior: where the solution stays in the directions that the data do not show. With an orientation, that is learnt
            too: its nine planes have a noise of their own and share λ with the position's.
        bases: what the solution is computed in; it decides what "nearest to the prior" means. None takes the prior's.
            Scaled orthonormal bases over the joints' ranges (`learning_bases`) are advised.
        forgetting: the factor by which each new pair lessens the weight of all before, as in `Memory`.

    Raises:
        BasisError: bases do not fit the prior.
        SettingError: forgetting is not a factor in 0..1.

    Example:
        >>> import numpy as np
        >>> from kbmaps import ExactLearner, RigidChain, learning_bases
        >>> fixed = np.tile(np.eye(4), (3, 1, 1))
        >>> fixed[1:, 0, 3] = 0.3, 0.2  # links [m]
        >>> arm = RigidChain(fixed, axes=[[0, 0, 1], [0, 1, 0]], prismatic=[False, False])
        >>> drawing = arm.with_tool([0.0, 0.0, 0.1])  # wrong about the marker
        >>> learner = ExactLearner(drawing.to_kbmap(learning_bases([-1, -1], [1, 1])))
        >>> q = np.random.default_rng(0).uniform(-1, 1, (9, 2))
        >>> learner.learn(q, arm.positions(q))
        >>> learner.solve().map.predict([0.0, -np.pi / 2]).round(9) + 0.0
        array([0.3, 0. , 0.2])
    """

    def __init__(self, prior: KBMap, bases: Sequence[JointBasis] | None = None, *, forgetting: float = 1.0) -> None:
        check_forgetting(forgetting)
        self._forgetting = float(forgetting)
        self._bases = prior.bases if bases is None else tuple(bases)
        self._stack = BasisStack(self._bases)
        self._outputs = len(prior.net)
        self._factor = RowFactor(prior.size, self._outputs)
        self._pending: list[tuple[FloatArray, FloatArray]] = []
        self._pending_rows = 0
        self._pairs = 0
        # Of the pairs that are not forgotten: their number, and the logarithms of their weights.
        self._count = 0.0
        self._log_weights = 0.0
        self._last_precision = _FIRST_PRECISION
        self.rebase(prior)

    @property
    def pairs(self) -> int:
        """How many pairs have been learnt."""
        return self._pairs

    @property
    def prior(self) -> KBMap:
        return self._prior

    def rebase(self, prior: KBMap) -> None:
        """Another prior for the same data.

        Raises:
            ShapeError: the prior has an orientation and the one before had none, or the other way round.
            BasisError: it has other joints.
        """
        if len(prior.net) != self._outputs:
            raise ShapeError("prior.net", f"({self._outputs}, ...) as before", prior.net.shape)
        if len(prior.bases) != len(self._bases):
            raise BasisError(f"the prior has {len(prior.bases)} joints, the learner {len(self._bases)}")
        self._prior_coefficients = prior.in_basis(self._bases).net.reshape(self._outputs, -1).T
        self._prior = prior

    def learn(
        self, q: ArrayLike, x: ArrayLike, weight: ArrayLike | None = None, rotation: ArrayLike | None = None
    ) -> None:
        """One pair, q (d,) [rad] and x (3,) [m], or many, (n, d) and (n, 3).

        Args:
            weight: relative inverse variance of each pair, () or (n,), greater than 0; None means 1.
            rotation: the orientations, rotation matrices (n, 3, 3) or quaternions x, y, z, w (n, 4), for one pair also
                (3, 3) or (4,); where the prior has an orientation, and only there.

        Raises:
            ShapeError, NonFiniteError, RotationError
            SettingError: a weight that is not positive, rotations too many or too few. Nothing has changed.
        """
        angles = np.atleast_2d(rows_or_vector("q", q, self._stack.joints))
        positions = np.atleast_2d(rows_or_vector("x", x, POSITION_OUTPUTS))
        if len(angles) != len(positions):
            raise ShapeError("x", f"({len(angles)}, 3) to go with q", positions.shape)
        targets = pose_targets(positions, rotation, self._outputs)
        weights = _checked_weights(weight, len(angles))
        for start in range(0, len(angles), _BLOCK):
            part = slice(start, start + _BLOCK)
            self._collect(angles[part], targets[part], weights[part])
        self._pairs += len(angles)
        ages = np.arange(len(angles) - 1, -1, -1.0)
        shares, faded = self._forgetting**ages, self._forgetting ** len(angles)
        self._count = self._count * faded + float(shares.sum())
        self._log_weights = self._log_weights * faded + float(shares @ np.log(weights))

    def solve(self, prior_precision: float | Literal["evidence"] | None = None) -> ExactSolution:
        """The map for all pairs so far.

        Args:
            prior_precision: None: least squares without regularisation; where the pairs do not determine it, the
                solution nearest to the prior in the learner's bases. λ > 0: minimises
                Σ weight ‖f(q) − x‖² + λ ‖g − g0‖² over the coefficients g, the posterior mean for a Gaussian prior of
                variance noise² / λ around g0. "evidence": λ of the greatest marginal likelihood.

        Raises:
            SettingError: prior_precision is neither None, "evidence", nor a number above 0.
        """
        if isinstance(prior_precision, str):
            if prior_precision != "evidence":
                raise SettingError(f'prior_precision must be None, "evidence" or a number, got {prior_precision!r}')
        elif prior_precision is not None and not (prior_precision > 0.0 and math.isfinite(prior_precision)):
            raise SettingError(f"prior_precision must be finite and greater than 0, got {prior_precision!r}")
        self._flush()
        if self._pairs == 0:
            return ExactSolution(self._prior, None, 0.0, None, 0.0)
        errors = self._factor.targets - self._factor.rows @ self._prior_coefficients
        if prior_precision is None:
            return self._solve_unregularised(errors)
        gram = ShiftedGram(self._factor.gram())
        if isinstance(prior_precision, str):
            prior_precision = self._most_evident(gram, errors)
            self._last_precision = prior_precision
        return self._solve_ridge(gram, errors, prior_precision)

    def _collect(self, q: FloatArray, targets: FloatArray, weights: FloatArray) -> None:
        scale = np.sqrt(weights)[:, None]
        self._pending.append((self._stack.full(q) * scale, targets * scale))
        self._pending_rows += len(q)
        if self._pending_rows >= _BLOCK:
            self._flush()

    def _flush(self) -> None:
        if self._pending:
            weighted_rows, targets = zip(*self._pending, strict=True)
            self._fold(np.concatenate(weighted_rows), np.concatenate(targets))
            self._pending.clear()
            self._pending_rows = 0

    def _fold(self, weighted_rows: FloatArray, targets: FloatArray) -> None:
        """Takes in rows (n, m) after all before have lost weight to them, and the earlier of them to the later."""
        if self._forgetting < 1.0:
            self._factor.fade(self._forgetting ** len(targets))
            scale = self._forgetting ** (0.5 * np.arange(len(targets) - 1, -1, -1.0))[:, None]
            weighted_rows, targets = weighted_rows * scale, targets * scale
        self._factor.add(weighted_rows, targets)

    def _solve_unregularised(self, errors: FloatArray) -> ExactSolution:
        factor = self._factor
        if factor.triangular:
            change = lapack.triangular_solve(factor.rows, errors, _SMALLEST_RCOND)
        else:
            change = lapack.smallest_solution(factor.rows, errors, _SMALLEST_RCOND)
        if change is None:
            change = self._nearest(errors)
        freedom = self._count - factor.unknowns
        squares = self._residual_squares(errors, change)
        noises = [math.sqrt(float(squares[part].mean()) / freedom) if freedom > 0 else None for part in self._parts]
        return self._solution(change, noises, 0.0, None, squares)

    def _nearest(self, errors: FloatArray) -> FloatArray:
        """The smallest change of the coefficients (m, outputs) that explains `errors` (k, outputs), whatever the rank.

        Iterated Tikhonov: each pass leaves the share λ / (σ² + λ) of what a singular value σ has still to explain, and
        corrects the rounding of the pass before. Directions with σ² far below λ stay at the prior.
        """
        a = self._factor.rows
        gram = ShiftedGram(self._factor.gram())
        ridge = _VANISHING_RIDGE * gram.trace
        while not gram.factorise(ridge):
            ridge *= 10.0
        change = a.T @ gram.solve(errors)
        left = float("inf")
        for _ in range(_REFINEMENTS):
            remaining = errors - a @ change
            size = float(np.linalg.norm(remaining))
            if not size < 0.5 * left:
                break
            left = size
            change = change + a.T @ gram.solve(remaining)
        return change

    def _solve_ridge(self, gram: ShiftedGram, errors: FloatArray, precision: float) -> ExactSolution:
        fit = self._fit(gram, errors, precision)
        a = self._factor.rows
        # One step of refinement through the rows themselves mends the rounding of the Gram matrix.
        remaining = errors - a @ (a.T @ fit.multipliers) - precision * fit.multipliers
        change = a.T @ (fit.multipliers + gram.solve(remaining))
        squares = self._residual_squares(errors, change)
        noises = [math.sqrt(variance) for variance in fit.variances]
        return self._solution(change, noises, precision, fit.log_evidence, squares)

    def _fit(self, gram: ShiftedGram, errors: FloatArray, precision: float) -> _Fit:
        """Evidence of λ. With A the kept rows, the errors of one coordinate are N(0, s² (A Aᵀ / λ + I))."""
        if not gram.factorise(precision):
            raise SettingError(f"prior_precision = {precision:.3g} is below rounding here; use None or a larger one")
        multipliers = gram.solve(errors)
        squares = precision * np.einsum("ko,ko->o", errors, multipliers) + self._factor.residual_squares
        spread = gram.log_determinant - len(errors) * math.log(precision)
        variances = [max(float(squares[part].mean()) / self._count, _VARIANCE_FLOOR) for part in self._parts]
        log_evidence = 0.0
        for part, variance in zip(self._parts, variances, strict=True):
            outputs = part.stop - part.start
            log_evidence -= 0.5 * outputs * self._count * (math.log(2.0 * math.pi * variance) + 1.0)
            log_evidence += 0.5 * outputs * (self._log_weights - spread)
        return _Fit(multipliers, variances, log_evidence)

    @property
    def _parts(self) -> list[slice]:
        """The outputs that share a noise: the positions, and the orientations where there are any."""
        positions = slice(0, POSITION_OUTPUTS)
        return [positions] if self._outputs == POSITION_OUTPUTS else [positions, slice(POSITION_OUTPUTS, POSE_OUTPUTS)]

    def _most_evident(self, gram: ShiftedGram, errors: FloatArray) -> float:
        """λ of the greatest evidence: climbs from the last one in steps, then takes the vertex of a parabola."""
        mean = gram.trace / len(errors)
        low, high = (limit * mean for limit in _SEARCH_LIMITS)
        return most_evident(
            lambda precision: self._fit(gram, errors, precision).log_evidence, self._last_precision, low, high
        )

    def _residual_squares(self, errors: FloatArray, change: FloatArray) -> FloatArray:
        remaining = errors - self._factor.rows @ change
        return np.square(remaining).sum(axis=0) + self._factor.residual_squares

    def _solution(
        self,
        change: FloatArray,
        noises: Sequence[float | None],
        precision: float,
        log_evidence: float | None,
        squares: FloatArray,
    ) -> ExactSolution:
        shape = (self._outputs, *(basis.size for basis in self._bases))
        learnt = KBMap(self._bases, (self._prior_coefficients + change).T.reshape(shape), self._prior.metadata)
        return ExactSolution(
            map=learnt.in_basis(self._prior.bases),
            noise_std=noises[0],
            prior_precision=precision,
            log_evidence=log_evidence,
            residual_rms=math.sqrt(float(squares[:POSITION_OUTPUTS].sum()) / self._count),
            orientation_noise_std=noises[1] if len(noises) > 1 else None,
        )


def _checked_weights(weight: ArrayLike | None, pairs: int) -> FloatArray:
    if weight is None:
        return np.ones(pairs)
    weights = np.asarray(weight, dtype=np.float64)
    if weights.shape not in ((), (pairs,)):
        raise ShapeError("weight", f"() or ({pairs},)", weights.shape)
    if not np.isfinite(weights).all():
        raise NonFiniteError("weight")
    if weights.size and weights.min() <= 0.0:
        raise SettingError("every weight must be greater than 0; leave a pair out instead of weighting it 0")
    return np.broadcast_to(weights, (pairs,))
