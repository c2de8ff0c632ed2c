"""Finding a rigid chain from pairs alone, without any drawing."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from kbmaps.arrays import BoolArray, FloatArray, IntArray, rows
from kbmaps.chains.chain import RigidChain
from kbmaps.chains.parameters import ChainParameters
from kbmaps.errors import DegenerateDataError, SettingError, ShapeError

_STEPS = 150
_FIRST_DAMPING, _LEAST_DAMPING, _LEAST_RAISED_DAMPING, _MOST_DAMPING = 1e-2, 1e-14, 1e-8, 1e6
# A start whose residual [m] is rounding has found the chain.
_ROUNDING_M = 1e-9
# A start that leaves less than this times the noise has found the chain.
_EXPLAINED = 1.2
# A step that mends less than this share of the squared residual ends a start, once it has happened a few times.
_STALLED, _STALLED_STEPS = 1e-4, 8


def find_chain(
    q: ArrayLike,
    x: ArrayLike,
    prismatic: Sequence[bool] | None = None,
    *,
    rng: np.random.Generator,
    starts: int = 20,
    sigma: float | None = None,
) -> RigidChain:
    """The chain that fits pairs best, of those reached from random chains; pairs must be without gross outliers.

    Ends early when a start explains the pairs, exactly or, with `sigma`, up to the noise. Without sigma noisy pairs
    take all the starts: local minima recur, so that reaching one twice says nothing. What positions cannot show (base
    and zeros apart from axes, the orientation of the marker) is arbitrary in the result, which is meant as the nominal
    chain of a learner.

    Args:
        q: joint angles (n, d) [rad, m]; x: marker positions (n, 3) [m].
        prismatic: which joints slide (d); None: all turn.
        rng: draws the starts.
        starts: how many random chains at most.
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
    width = np.shape(q)[-1] if np.ndim(q) == 2 else 0
    angles, positions = rows("q", q, max(width, 1)), rows("x", x, 3)
    slides = np.zeros(angles.shape[1], dtype=np.bool_) if prismatic is None else np.array(prismatic, dtype=np.bool_)
    if len(angles) != len(positions):
        raise ShapeError("x", f"({len(angles)}, 3) to go with q", positions.shape)
    if slides.shape != (angles.shape[1],):
        raise ShapeError("prismatic", f"({angles.shape[1]},)", slides.shape)
    if starts < 1:
        raise SettingError(f"starts must be 1 or greater, got {starts!r}")
    if sigma is not None and not (sigma > 0.0 and math.isfinite(sigma)):
        raise SettingError(f"sigma must be finite and greater than 0, got {sigma!r}")
    unknowns = 3 + 4 * int((~slides).sum()) + 2 * int(slides.sum())
    if 3 * len(angles) < unknowns:
        raise DegenerateDataError(
            f"{len(angles)} pairs cannot determine the {unknowns} unknowns of this chain; record {-(-unknowns // 3)}"
        )
    size = float(np.linalg.norm(positions - positions.mean(axis=0), axis=1).mean())
    if not size > _ROUNDING_M:
        raise DegenerateDataError("all positions lie in one place; record pairs that spread out")
    enough = max(_ROUNDING_M, _EXPLAINED * (sigma or 0.0) * math.sqrt(max(3.0 - unknowns / len(angles), 0.0)))
    return _best_of(angles, positions, slides, size, rng, starts, enough)


def _best_of(
    q: FloatArray, x: FloatArray, slides: BoolArray, size: float, rng: np.random.Generator, starts: int, enough: float
) -> RigidChain:
    """The best of at most `starts` descents, the first whose RMS residual is `enough` [m] ends the search."""
    centre = x.mean(axis=0)
    best, best_rms = _descend(_random_chain(slides, centre, size, rng), q, x, size)
    for _ in range(1, starts):
        if best_rms <= enough:
            break
        chain, rms = _descend(_random_chain(slides, centre, size, rng), q, x, size)
        if rms < best_rms:
            best, best_rms = chain, rms
    return best


def _random_chain(slides: BoolArray, centre: FloatArray, size: float, rng: np.random.Generator) -> RigidChain:
    """A chain whose axes at zero have any direction and pass where the positions are."""
    axes = rng.normal(size=(len(slides), 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    points = np.concatenate([centre + size * rng.normal(size=(len(slides), 3)), centre[None]])
    fixed = np.tile(np.eye(4), (len(slides) + 1, 1, 1))
    fixed[:, :3, 3] = np.diff(points, axis=0, prepend=np.zeros((1, 3)))
    return RigidChain(fixed, axes, slides)


def _descend(chain: RigidChain, q: FloatArray, x: FloatArray, size: float) -> tuple[RigidChain, float]:
    """Levenberg-Marquardt from one chain, each step around the chain it has reached; with the RMS residual [m]."""
    damping, stalled, square = _FIRST_DAMPING, 0, math.inf
    for _ in range(_STEPS):
        parameters = ChainParameters(chain)
        predicted, jacobian = parameters.linearised(np.zeros(parameters.size), q)
        residual = x - predicted
        last, square = square, float(np.square(residual).sum())
        stalled = stalled + 1 if square > (1.0 - _STALLED) * last else 0
        if stalled >= _STALLED_STEPS or square <= len(x) * (1e-3 * _ROUNDING_M) ** 2:
            break
        free, scales = _free(parameters, size)
        design = (jacobian[:, :, free] * scales).reshape(residual.size, -1)
        gram, slope = design.T @ design, design.T @ residual.ravel()
        held = np.diag(gram) + 1e-3 * size**2
        change = np.zeros(parameters.size)
        while damping <= _MOST_DAMPING:
            change[free] = scales * np.linalg.solve(gram + np.diag(damping * held), slope)
            if np.square(x - parameters.positions(change, q)).sum() < square:
                break
            damping = max(4.0 * damping, _LEAST_RAISED_DAMPING)
        else:
            break
        chain, damping = parameters.chain(change), max(0.2 * damping, _LEAST_DAMPING)
    return chain, math.sqrt(square / len(x))


def _free(parameters: ChainParameters, size: float) -> tuple[IntArray, FloatArray]:
    """The parameters that positions can show, and a unit for each."""
    scales = np.zeros(parameters.size)
    scales[parameters.tilts] = 1.0
    scales[parameters.shifts] = size * np.repeat(~parameters.reference.prismatic, 2)
    scales[parameters.tool] = size
    free = np.flatnonzero(scales)
    return free, scales[free]
