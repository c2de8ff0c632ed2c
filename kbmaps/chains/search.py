"""Search for a rigid chain from pairs alone, without a nominal model."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from kbmaps.arrays import BoolArray, FloatArray, rows
from kbmaps.chains.chain import RigidChain
from kbmaps.chains.descents import Descents, ScrewArms
from kbmaps.errors import DegenerateDataError, SettingError, ShapeError
from kbmaps.robust import ROUNDING_M

# A start whose residual is below this multiple of the noise has found the chain.
_EXPLAINED = 1.2


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
    proves nothing. What positions cannot determine (base and joint offsets apart from axes, the orientation of the
    marker) is arbitrary in the result. Use it as the nominal chain of a learner.

    Args:
        q: joint angles (n, d) [rad, m].
        x: marker positions (n, 3) [m].
        prismatic: True for each joint (d) that slides; None: all turn.
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
    if not size > ROUNDING_M:
        raise DegenerateDataError("all positions lie in one place; record pairs that spread out")
    enough = max(ROUNDING_M, _EXPLAINED * (sigma or 0.0) * math.sqrt(max(3.0 - unknowns / len(angles), 0.0)))
    return _best_of(angles, positions, slides, size, rng, starts, enough)


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
