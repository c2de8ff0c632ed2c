"""Search for a rigid chain from pairs alone, without a nominal model."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from kbmaps.arrays import BoolArray, FloatArray, IntArray, matching_rows, require_positive
from kbmaps.chains.chain import RigidChain
from kbmaps.chains.parameters import tangents
from kbmaps.errors import DegenerateDataError, SettingError, ShapeError
from kbmaps.robust import RobustSettings
from kbmaps.rotations import cross_matrix


class _Settings:
    steps: int = 150
    first_damping: float = 1e-2
    min_damping: float = 1e-14
    min_raised_damping: float = 1e-8
    max_damping: float = 1e6
    exact_m: float = 1e-12  # a start with a residual [m] this small has found the chain to the last digits
    # A start ends after this many steps that each reduce the squared residual by less than this share.
    stalled: float = 1e-4
    stalled_steps: int = 8
    explained: float = 1.2  # a start whose residual is below this multiple of the noise has found the chain


@dataclass(frozen=True, eq=False)
class ScrewArms:
    """Chains given by the location of their joint axes with all joints at zero (Brockett 1984)."""

    axes: FloatArray  # unit axes (s, d, 3)
    points: FloatArray  # a point of each axis (s, d, 3), then the marker position (s, d+1, 3) [m]

    def __getitem__(self, chosen: BoolArray | IntArray) -> ScrewArms:
        return ScrewArms(self.axes[chosen], self.points[chosen])

    def chain(self, index: int, slides: BoolArray) -> RigidChain:
        """Return one chain; with the joints at zero, all its frames are parallel to the measurement frame."""
        fixed = np.tile(np.eye(4), (len(slides) + 1, 1, 1))
        fixed[:, :3, 3] = np.diff(self.points[index], axis=0, prepend=np.zeros((1, 3)))
        return RigidChain(fixed, self.axes[index], slides)

    def changed(self, steps: FloatArray) -> ScrewArms:
        """Return the chains after steps (s, 4 d + 3).

        A step holds tilts of the axes about two `tangents` [rad], their shifts along these [m] and the marker's
        displacement [m].
        """
        count, d = self.axes.shape[:2]
        across = tangents(self.axes.reshape(-1, 3)).reshape(count, d, 3, 2)
        tilts = steps[:, : 2 * d].reshape(count, d, 2, 1)
        angles = np.sqrt(np.einsum("sdti,sdti->sdi", tilts, tilts))
        # The second tangent is axis × first, so a turn by (α, β) moves the axis along (β, −α).
        along = (across @ np.stack([tilts[:, :, 1], -tilts[:, :, 0]], axis=2))[..., 0]
        axes = np.cos(angles) * self.axes + np.sinc(angles / np.pi) * along
        axes /= np.sqrt(np.einsum("sdi,sdi->sd", axes, axes))[..., None]
        points = self.points.copy()
        points[:, :-1] += (across @ steps[:, 2 * d : 4 * d].reshape(count, d, 2, 1))[..., 0]
        points[:, -1] += steps[:, 4 * d :]
        return ScrewArms(axes, points)


@dataclass(frozen=True, eq=False)
class _Reached:
    """Marker positions of each chain; pairs come last so that all of them are one vector operation."""

    turned: FloatArray  # R_kᵀ (d+1, s, 3, 3, n), R_k the rotation before joint k, and of the marker
    levers: FloatArray  # from each joint's point to the marker (d, s, 3, n) [m]
    residuals: FloatArray  # (s, 3, n) [m]
    squares: FloatArray  # their sums of squares (s,) [m²]

    def __getitem__(self, chosen: BoolArray | IntArray) -> _Reached:
        return _Reached(self.turned[:, chosen], self.levers[:, chosen], self.residuals[chosen], self.squares[chosen])


class Descents:
    """Levenberg-Marquardt from several starting chains at once.

    Args:
        q: joint angles (n, d) [rad, m].
        x: marker positions (n, 3) [m].
        slides: True for each prismatic joint (d,).
        size: spread of the positions [m].
    """

    def __init__(self, q: FloatArray, x: FloatArray, slides: BoolArray, size: float) -> None:
        self._x, self._slides = np.ascontiguousarray(x.T), slides
        angles = np.where(slides, 0.0, q).T
        self._sines, self._versines = np.sin(angles), 1.0 - np.cos(angles)
        self._moves = np.where(slides, q, 0.0).T
        scales = np.concatenate([np.ones(2 * len(slides)), np.repeat(np.where(slides, 0.0, size), 2), np.full(3, size)])
        self._free = np.flatnonzero(scales)
        self._scales = scales
        self._held = 1e-3 * size**2

    def run(self, starts: ScrewArms, enough: float) -> tuple[ScrewArms, FloatArray]:
        """Return the fitted chains and their RMS residuals [m]. All stop as soon as one ends at `enough` or below."""
        arms, count = ScrewArms(starts.axes.copy(), starts.points.copy()), len(starts.axes)
        pairs = self._x.shape[1]
        reached = self._reach(arms)
        gram, slope = self._normal(arms, reached)
        damping, squares = np.full(count, _Settings.first_damping), reached.squares.copy()
        stalled, steps = np.zeros(count, dtype=np.intp), np.zeros(count, dtype=np.intp)
        active = np.flatnonzero(squares > pairs * _Settings.exact_m**2)
        while len(active):
            change = self._step(gram[active], slope[active], damping[active])
            tried = arms[active].changed(change)
            reached = self._reach(tried)
            better = reached.squares < squares[active]
            taken, failed = active[better], active[~better]
            if len(taken):
                arms.axes[taken], arms.points[taken] = tried.axes[better], tried.points[better]
                last, squares[taken] = squares[taken], reached.squares[better]
                stalled[taken] = np.where(squares[taken] > (1.0 - _Settings.stalled) * last, stalled[taken] + 1, 0)
                damping[taken] = np.maximum(0.2 * damping[taken], _Settings.min_damping)
                steps[taken] += 1
                gram[taken], slope[taken] = self._normal(arms[taken], reached[better])
            damping[failed] = np.maximum(4.0 * damping[failed], _Settings.min_raised_damping)
            ended = (
                (stalled >= _Settings.stalled_steps) | (steps >= _Settings.steps) | (damping > _Settings.max_damping)
            )
            ended |= squares <= pairs * _Settings.exact_m**2
            if (squares[ended] <= pairs * enough**2).any():
                break
            active = active[~ended[active]]
        return arms, np.sqrt(squares / pairs)

    def _reach(self, arms: ScrewArms) -> _Reached:
        count, d = arms.axes.shape[:2]
        n = self._x.shape[1]
        turned = np.empty((d + 1, count, 3, 3, n))
        turned[0] = np.eye(3)[:, :, None]
        # R_{k+1}ᵀ = R_kᵀ − sin q [a]× R_kᵀ + (1 − cos q) [a]×² R_kᵀ (Rodrigues)
        cross = cross_matrix(arms.axes)
        terms = np.concatenate([-cross, cross @ cross], axis=2)
        for k in range(d):
            parts = (terms[:, k] @ turned[k].reshape(count, 3, 3 * n)).reshape(count, 2, 3, 3, n)
            np.multiply(parts[:, 0], self._sines[k], out=parts[:, 0])
            parts[:, 1] *= self._versines[k]
            np.add(turned[k], parts[:, 0], out=turned[k + 1])
            turned[k + 1] += parts[:, 1]
        links = np.diff(arms.points, axis=1).swapaxes(0, 1)[:, :, None]
        spans = (links @ turned[1:].reshape(d, count, 3, 3 * n)).reshape(d, count, 3, n)
        for k in np.flatnonzero(self._slides):
            axis = (arms.axes[:, k, None] @ turned[k].reshape(count, 3, 3 * n)).reshape(count, 3, n)
            spans[k] += self._moves[k] * axis
        levers = spans[::-1].cumsum(axis=0)[::-1]
        residuals = self._x - arms.points[:, 0, :, None] - levers[0]
        return _Reached(turned, levers, residuals, np.einsum("sin,sin->s", residuals, residuals))

    def _normal(self, arms: ScrewArms, reached: _Reached) -> tuple[FloatArray, FloatArray]:
        """Return the Gram matrices (s, f, f) of the Jacobians and their products with the residuals (s, f).

        A tilt of an axis about u moves the marker by (R_k u − R_{k+1} u) × lever, a shift by v moves it by
        R_k v − R_{k+1} v.
        """
        count, d = arms.axes.shape[:2]
        n = self._x.shape[1]
        across = tangents(arms.axes.reshape(-1, 3)).reshape(count, d, 3, 2).transpose(1, 0, 3, 2)
        turned = reached.turned.reshape(d + 1, count, 3, 3 * n)
        moved = (across @ (turned[:-1] - turned[1:])).reshape(d, count, 2, 3, n)
        lever = reached.levers[:, :, None]
        jacobian = np.empty((count, 4 * d + 3, 3, n))
        tilts = jacobian[:, : 2 * d].reshape(count, d, 2, 3, n).swapaxes(0, 1)
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            np.multiply(moved[..., j, :], lever[..., k, :], out=tilts[..., i, :])
            tilts[..., i, :] -= moved[..., k, :] * lever[..., j, :]
        for k in np.flatnonzero(self._slides):
            turned_axis = np.cross(across[k], arms.axes[:, k, None])
            parts = (turned_axis @ turned[k]).reshape(count, 2, 3, n)
            tilts[k] = self._moves[k] * parts
        jacobian[:, 2 * d : 4 * d].reshape(count, d, 2, 3, n)[...] = moved.swapaxes(0, 1)
        jacobian[:, 4 * d :] = reached.turned[-1]
        design = jacobian.reshape(count, 4 * d + 3, 3 * n)
        if len(self._free) < 4 * d + 3:
            design = design[:, self._free]
        scales = self._scales[self._free]
        gram = design @ design.swapaxes(1, 2) * (scales[:, None] * scales)
        return gram, (design @ reached.residuals.reshape(count, 3 * n, 1))[..., 0] * scales

    def _step(self, gram: FloatArray, slope: FloatArray, damping: FloatArray) -> FloatArray:
        held = np.einsum("sff->sf", gram) + self._held
        damped = gram.copy()
        np.einsum("sff->sf", damped)[...] += damping[:, None] * held
        steps = np.zeros((len(gram), len(self._scales)))
        steps[:, self._free] = self._scales[self._free] * np.linalg.solve(damped, slope[..., None])[..., 0]
        return steps


def find_chain(
    q: ArrayLike,
    x: ArrayLike,
    prismatic: Sequence[bool] | None = None,
    *,
    rng: np.random.Generator,
    starts: int = 20,
    sigma: float | None = None,
) -> RigidChain:
    """Return the chain that fits the pairs best, of those reached from random chains.

    The pairs must be free of gross outliers. The search ends early when a start explains the pairs, exactly or, with
    `sigma`, up to the noise. Without sigma, noisy pairs use all the starts: local minima recur, so reaching one twice
    proves nothing. Quantities that positions do not determine (base and joint offsets apart from axes, the orientation
    of the marker) are arbitrary in the result. Use it as the nominal chain of a learner.

    Args:
        q: joint angles (n, d) [rad, m].
        x: marker positions (n, 3) [m].
        prismatic: True for each prismatic joint (d); None if all are revolute.
        rng: random generator of the starts.
        starts: maximum number of random chains.
        sigma: noise of a coordinate [m], if known.

    Raises:
        ShapeError, NonFiniteError, SettingError (no starts, a sigma that is not positive)
        DegenerateDataError: fewer pairs than unknowns, or all positions in one place.

    Example:
        >>> import numpy as np
        >>> from kbmaps import RigidChain, find_chain
        >>> fixed = np.tile(np.eye(4), (3, 1, 1))
        >>> fixed[1:, 0, 3] = 0.3, 0.2  # links [m]
        >>> arm = RigidChain(fixed, axes=[[0, 0, 1], [0, 1, 0]], prismatic=[False, False])
        >>> q = np.random.default_rng(0).uniform(-1, 1, (20, 2))
        >>> found = find_chain(q, arm.positions(q), rng=np.random.default_rng(1))
        >>> found.positions([0.0, -np.pi / 2]).round(6) + 0.0
        array([0.3, 0. , 0.2])
    """
    if not isinstance(rng, np.random.Generator):  # pyright: ignore[reportUnnecessaryIsInstance]
        raise SettingError(f"rng must be a generator, as numpy.random.default_rng(0) makes one; got {rng!r}")
    width = np.shape(q)[-1] if np.ndim(q) == 2 else 0
    angles, positions = matching_rows(q, x, max(width, 1))
    slides = np.zeros(angles.shape[1], dtype=np.bool_) if prismatic is None else np.array(prismatic, dtype=np.bool_)
    if slides.shape != (angles.shape[1],):
        raise ShapeError("prismatic", f"({angles.shape[1]},)", slides.shape)
    if starts < 1:
        raise SettingError(f"starts must be 1 or greater, got {starts!r}")
    if sigma is not None:
        require_positive("sigma", sigma)
    unknowns = 3 + 4 * int((~slides).sum()) + 2 * int(slides.sum())
    if 3 * len(angles) < unknowns:
        raise DegenerateDataError(
            f"{len(angles)} pairs cannot determine the {unknowns} unknowns of this chain; record {-(-unknowns // 3)}"
        )
    size = float(np.linalg.norm(positions - positions.mean(axis=0), axis=1).mean())
    if not size > RobustSettings.rounding_m:
        raise DegenerateDataError("all positions lie in one place; record pairs that spread out")
    enough = _Settings.explained * (sigma or 0.0) * math.sqrt(max(3.0 - unknowns / len(angles), 0.0))
    return _best_of(angles, positions, slides, size, rng, starts, max(RobustSettings.rounding_m, enough))


def _best_of(
    q: FloatArray, x: FloatArray, slides: BoolArray, size: float, rng: np.random.Generator, starts: int, enough: float
) -> RigidChain:
    """Return the best of at most `starts` descents; the first with an RMS residual of `enough` [m] ends the search."""
    descents = Descents(q, x, slides, size)
    best, best_rms = None, math.inf
    side_by_side = 1
    while best is None or (starts > 0 and best_rms > enough):
        # Often the first start succeeds. Each failure makes it likelier that many are needed.
        count = min(side_by_side, starts)
        arms, rms = descents.run(_random_arms(count, len(slides), x.mean(axis=0), size, rng), enough)
        winner = int(rms.argmin())
        if best is None or rms[winner] < best_rms:
            best, best_rms = arms.chain(winner, slides), float(rms[winner])
        starts -= count
        side_by_side *= 2
    return best


def _random_arms(count: int, joints: int, centre: FloatArray, size: float, rng: np.random.Generator) -> ScrewArms:
    """Return arms whose axes at zero have random directions and pass near the positions."""
    axes, points = np.empty((count, joints, 3)), np.empty((count, joints + 1, 3))
    for arm in range(count):
        axes[arm] = rng.normal(size=(joints, 3))
        points[arm, :-1] = centre + size * rng.normal(size=(joints, 3))
    axes /= np.linalg.norm(axes, axis=2, keepdims=True)
    points[:, -1] = centre
    return ScrewArms(axes, points)
