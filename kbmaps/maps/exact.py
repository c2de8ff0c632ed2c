"""Exact least squares: the best control points for all pairs so far. Ulbrich et al. 2009, eqs. (16)-(18)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from kbmaps import lapack
from kbmaps.arrays import FloatArray, numbers
from kbmaps.errors import BasisError, NonFiniteError, SettingError, ShapeError
from kbmaps.maps.basis import JointBasis
from kbmaps.maps.design import Design
from kbmaps.maps.evidence import most_evident
from kbmaps.maps.factor import ShiftedGram
from kbmaps.maps.kbmap import POSE_OUTPUTS, POSITION_OUTPUTS, KBMap, pose_targets
from kbmaps.memory import Memory
from kbmaps.pairs import checked_pairs
from kbmaps.robust import RobustSettings


class ExactSettings:
    # Below this reciprocal condition number a triangular solve would return rounding errors.
    smallest_rcond: float = 1e-13
    # The same for a Gram matrix, of which the refinement through the pairs needs only the first digits.
    smallest_gram_rcond: float = 1e-15
    # Refinement must gain this factor per step; otherwise the Gram matrix is too near to singular.
    min_gain: float = 10.0
    # Relative to the trace of the Gram matrix: just enough for a stable Cholesky factorisation.
    vanishing_ridge: float = 1e-13
    refinements: int = 30
    first_precision: float = 1e-2
    # Limits of the evidence's search for lambda, relative to the mean diagonal of the Gram matrix.
    search_limits = (1e-12, 1e6)


def nearest_solution(design: Design, errors: FloatArray) -> FloatArray:
    """Return the smallest change (m, outputs) of the coefficients that explains errors (n, outputs) best.

    Uses Cholesky factors of the Gram matrix if they suffice. Refinement through the pairs then matches a QR
    factorisation (corrected seminormal equations, Björck 1987), at a tenth of its cost.
    """
    gram = ShiftedGram(design.gram())
    if gram.factorise(0.0) and gram.rcond > ExactSettings.smallest_gram_rcond:
        change = _refined(design, gram, errors)
        if change is not None:
            return change
    del gram
    return _by_rows(design, errors)


def _refined(design: Design, gram: ShiftedGram, errors: FloatArray) -> FloatArray | None:
    """Refine down to rounding; return None if the steps gain too little."""

    def step(remaining: FloatArray) -> FloatArray:
        if design.overdetermined:
            return gram.solve(design.transposed_times(remaining))
        return design.transposed_times(gram.solve(remaining))

    change = step(errors)
    left = float(np.linalg.norm(change))
    if left == 0.0:
        return change
    for done in range(ExactSettings.refinements):
        correction = step(errors - design.times(change))
        size = float(np.linalg.norm(correction))
        if not size * ExactSettings.min_gain < left:
            return change if done else None
        change, left = change + correction, size
    return change


def _by_rows(design: Design, errors: FloatArray) -> FloatArray:
    """Solve through the rows themselves or their QR factor."""
    if design.overdetermined:
        factor = design.factor(errors)
        rows, targets = factor.rows, factor.targets
        change = lapack.triangular_solve(rows, targets, ExactSettings.smallest_rcond)
    else:
        rows, targets = design.rows(), errors
        change = lapack.smallest_solution(rows, targets, ExactSettings.smallest_rcond)
    return _nearest(rows, targets) if change is None else change


def _nearest(rows: FloatArray, errors: FloatArray) -> FloatArray:
    """Return the smallest change of the coefficients (m, outputs) that explains `errors` (k, outputs), at any rank.

    Iterated Tikhonov: for a singular value σ, each pass leaves the share λ / (σ² + λ) of the remaining error, and
    corrects the rounding of the pass before. Directions with σ² far below λ stay at the prior.
    """
    gram = ShiftedGram((rows @ rows.T).T)
    ridge = ExactSettings.vanishing_ridge * gram.trace
    while not gram.factorise(ridge):
        ridge *= 10.0
    change = rows.T @ gram.solve(errors)
    left = float("inf")
    for _ in range(ExactSettings.refinements):
        remaining = errors - rows @ change
        size = float(np.linalg.norm(remaining))
        if not size < 0.5 * left:
            break
        left = size
        change = change + rows.T @ gram.solve(remaining)
    return change


@dataclass(frozen=True)
class ExactSolution:
    """Fitted map with the quality of the fit.

    Attributes:
        map: the map, in the bases of the learner's prior.
        noise_std: estimated noise of one coordinate at weight 1 [m]; None if the data do not determine it.
        orientation_noise_std: the same of one entry of the rotation matrices; None also without orientations.
        prior_precision: λ = (noise_std / spread of the prior's coefficients)²; 0 for the unregularised solution.
        log_evidence: log marginal likelihood of all learnt pairs at λ; None for the unregularised solution.
        residual_rms: weighted RMS distance between the map's positions and the fitted ones [m].
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

        Multiplied by `SupportSet.spread` (in the learner's bases) it is the 1-sigma of a predicted coordinate.
        """
        if self.noise_std is None or self.prior_precision == 0.0:
            return None
        return self.noise_std / math.sqrt(self.prior_precision)


@dataclass(frozen=True)
class _Fit:
    """Fit at one λ before refinement, with its evidence and the noise variances of positions and of orientations.

    The solution is the change of the coefficients (m, outputs). With fewer pairs than unknowns, it is the multipliers
    (n, outputs) from which the change follows. `remaining` (n, outputs) holds the residuals, in the first case only.
    """

    precision: float
    solution: FloatArray
    remaining: FloatArray | None
    variances: list[float]
    log_evidence: float


class ExactLearner:
    """Learner that collects pairs, and solves for the map on demand.

    The pairs are kept unchanged. If there are more than control points, so are the sums for their Gram matrix. The
    prior is part of neither, so it may change (`rebase`). At d = 7 a pair takes 88 bytes, 6 µs to learn and 5 µs of
    each solve. The rest of a solve is one Cholesky factorisation of at most (3^d)², within 8 · 9^d bytes (38 MB). If
    the data are too one-sided for it, the solution comes from a QR factorisation of all pairs: exact, and slow.

    Args:
        prior: the solution in the directions that the data do not determine. If it has an orientation, that is learnt
            too: its nine planes have a separate noise and share λ with the position's.
        bases: the bases of the solution, and so the metric of "nearest to the prior". None for the prior's. Scaled
            orthonormal bases over the joints' ranges (`learning_bases`) are advised.
        memory: treatment of old pairs; all count by default.

    Raises:
        BasisError: bases do not fit the prior.

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

    def __init__(
        self, prior: KBMap, bases: Sequence[JointBasis] | None = None, *, memory: Memory | None = None
    ) -> None:
        self._memory = Memory() if memory is None else memory
        self._bases = prior.bases if bases is None else tuple(bases)
        self._outputs = len(prior.net)
        self._design = Design(self._bases, self._outputs)
        self._pairs = 0
        # Original weights of the kept pairs; the design holds them after forgetting.
        self._told = np.empty(0)
        self._last_precision = ExactSettings.first_precision
        self.rebase(prior)

    @property
    def pairs(self) -> int:
        """Number of learnt pairs, forgotten ones included."""
        return self._pairs

    @property
    def prior(self) -> KBMap:
        return self._prior

    def rebase(self, prior: KBMap) -> None:
        """Replace the prior for the same data.

        Raises:
            ShapeError: only one of the new prior and the old one has an orientation.
            BasisError: wrong number of joints.
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
        """Learn one pair, q (d,) [rad] and x (3,) [m], or many, (n, d) and (n, 3).

        Args:
            q: joint values.
            x: measured positions.
            weight: relative inverse variance of each pair, () or (n,), greater than 0; None means 1.
            rotation: the orientations, rotation matrices (n, 3, 3) or quaternions x, y, z, w (n, 4), for one pair also
                (3, 3) or (4,); required if the prior has an orientation, and only then.

        Raises:
            SettingError: a weight that is not positive, rotations missing or not expected. Nothing has changed.
        """
        angles, positions, _ = checked_pairs(q, x, None, len(self._bases))
        targets = pose_targets(positions, rotation, self._outputs)
        weights = _checked_weights(weight, len(angles))
        shares = self._memory.weights(len(angles) + 1)
        self._design.fade(float(shares[0]))
        self._design.add(angles, targets, weights * shares[1:])
        kept = self._memory.kept(len(self._design))
        self._design.keep(kept)
        self._told = np.concatenate([self._told, weights])[-kept:]
        self._pairs += len(angles)

    def solve(self, prior_precision: float | Literal["evidence"] | None = None) -> ExactSolution:
        """Return the map for all pairs so far.

        Args:
            prior_precision: None: least squares without regularisation; if the pairs do not determine it, the solution
                nearest to the prior in the learner's bases. λ > 0: minimises Σ weight ‖f(q) − x‖² + λ ‖g − g0‖² over
                the coefficients g, the posterior mean for a Gaussian prior of variance noise² / λ around g0.
                "evidence": λ of the greatest marginal likelihood.

        Raises:
            SettingError: prior_precision is neither None, "evidence", nor a number above 0.
        """
        if isinstance(prior_precision, str):
            if prior_precision != "evidence":
                raise SettingError(f'prior_precision must be None, "evidence" or a number, got {prior_precision!r}')
        elif prior_precision is not None and not (prior_precision > 0.0 and math.isfinite(prior_precision)):
            raise SettingError(f"prior_precision must be finite and greater than 0, got {prior_precision!r}")
        if self.pairs == 0:
            return ExactSolution(self._prior, None, 0.0, None, 0.0)
        errors = self._design.errors(self._prior_coefficients)
        if prior_precision is None:
            change = nearest_solution(self._design, errors)
            freedom = self._count - self._design.unknowns
            squares = self._residual_squares(errors, change)
            noises = [math.sqrt(float(squares[part].mean()) / freedom) if freedom > 0 else None for part in self._parts]
            return self._solution(change, noises, 0.0, None, squares)
        gram = ShiftedGram(self._design.gram())
        rhs = self._design.transposed_times(errors) if self._design.overdetermined else errors
        if isinstance(prior_precision, str):
            fit = self._most_evident(gram, errors, rhs)
            self._last_precision = fit.precision
        else:
            fit = self._fit(gram, errors, rhs, prior_precision)
        return self._refined(gram, errors, fit)

    def _refined(self, gram: ShiftedGram, errors: FloatArray, fit: _Fit) -> ExactSolution:
        """Take one step of refinement through the pairs, which corrects the rounding of the Gram matrix."""
        gram.factorise(fit.precision)
        design, change = self._design, fit.solution
        if fit.remaining is not None:
            rest = design.transposed_times(fit.remaining) - fit.precision * change
            change = change + gram.solve(rest)
        else:
            remaining = errors - design.times(design.transposed_times(fit.solution))
            multipliers = fit.solution + gram.solve(remaining - fit.precision * fit.solution)
            change = design.transposed_times(multipliers)
        squares = self._residual_squares(errors, change)
        noises = [math.sqrt(variance) for variance in fit.variances]
        return self._solution(change, noises, fit.precision, fit.log_evidence, squares)

    def _fit(self, gram: ShiftedGram, errors: FloatArray, rhs: FloatArray, precision: float) -> _Fit:
        """Fit at λ, with its evidence. The errors of one coordinate are N(0, s² (A Aᵀ / λ + I)).

        With fewer pairs than unknowns through A Aᵀ, otherwise through AᵀA, which has the same determinant except for
        powers of λ.
        """
        if not gram.factorise(precision):
            raise SettingError(f"prior_precision = {precision:.3g} is below rounding here; use None or a larger one")
        solution, remaining = gram.solve(rhs), None
        if self._design.overdetermined:
            remaining = errors - self._design.times(solution)
            squares = np.square(remaining).sum(axis=0) + precision * np.square(solution).sum(axis=0)
        else:
            squares = precision * np.einsum("ko,ko->o", errors, solution)
        spread = gram.log_determinant - gram.size * math.log(precision)
        variances = [
            max(float(squares[part].mean()) / self._count, RobustSettings.variance_floor) for part in self._parts
        ]
        log_evidence = 0.0
        for part, variance in zip(self._parts, variances, strict=True):
            outputs = part.stop - part.start
            log_evidence -= 0.5 * outputs * self._count * (math.log(2.0 * math.pi * variance) + 1.0)
            log_evidence += 0.5 * outputs * (self._log_weights - spread)
        return _Fit(precision, solution, remaining, variances, log_evidence)

    @property
    def _count(self) -> float:
        """Effective number of pairs, with forgetting."""
        return float(self._memory.weights(len(self._told)).sum())

    @property
    def _log_weights(self) -> float:
        return float(self._memory.weights(len(self._told)) @ np.log(self._told))

    @property
    def _parts(self) -> list[slice]:
        """Outputs that share a noise: the positions, and the orientations if there are any."""
        positions = slice(0, POSITION_OUTPUTS)
        return [positions] if self._outputs == POSITION_OUTPUTS else [positions, slice(POSITION_OUTPUTS, POSE_OUTPUTS)]

    def _most_evident(self, gram: ShiftedGram, errors: FloatArray, rhs: FloatArray) -> _Fit:
        """Return the fit at λ of the greatest evidence, searched from the last λ on."""
        mean = gram.trace / gram.size
        low, high = (limit * mean for limit in ExactSettings.search_limits)
        fits: dict[float, _Fit] = {}

        def log_evidence(precision: float) -> float:
            fits[precision] = self._fit(gram, errors, rhs, precision)
            return fits[precision].log_evidence

        return fits[most_evident(log_evidence, self._last_precision, low, high)]

    def _residual_squares(self, errors: FloatArray, change: FloatArray) -> FloatArray:
        return np.square(errors - self._design.times(change)).sum(axis=0)

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
    weights = numbers("weight", weight)
    if weights.shape not in ((), (pairs,)):
        raise ShapeError("weight", f"() or ({pairs},)", weights.shape)
    if not np.isfinite(weights).all():
        raise NonFiniteError("weight")
    if weights.size and weights.min() <= 0.0:
        raise SettingError("every weight must be greater than 0; leave a pair out instead of weighting it 0")
    return np.broadcast_to(weights, (pairs,))
