"""Forecast of the accuracy gained by further pairs of different motions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise
from typing import cast

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import ndtr, ndtri  # pyright: ignore[reportMissingTypeStubs, reportUnknownVariableType]

from kbmaps.arrays import FloatArray, rows, vector
from kbmaps.errors import SettingError
from kbmaps.planning.design import ExperimentDesign, Posterior

SAME, ALL = "as so far", "all joints"


@dataclass(frozen=True)
class ExpectedError:
    """Expected errors after one kind of motion.

    Attributes:
        motion: its name.
        errors: expected mean error [m] after each requested number of pairs.
    """

    motion: str
    errors: tuple[float, ...]


@dataclass(frozen=True)
class Forecast:
    """Expected gain of further pairs over a region.

    Attributes:
        now: expected mean error [m].
        least: the part of it [m] that no pair reduces, since the model cannot follow the arm.
        pairs: requested numbers of further pairs.
        motions: expected errors of the motions, the one that gains most first.
    """

    now: float
    least: float
    pairs: tuple[int, ...]
    motions: tuple[ExpectedError, ...]

    def error_after(self, motion: str, pairs: int) -> float:
        """Return the expected mean error [m].

        Raises:
            SettingError: it is not in the forecast.
        """
        for expected in self.motions:
            if expected.motion == motion and pairs in self.pairs:
                return expected.errors[self.pairs.index(pairs)]
        raise SettingError(f"{pairs} pairs of the motion {motion!r} are not in the forecast")

    def is_enough(self, share: float = 0.1) -> bool:
        """Return True if no motion would lower the error by more than this share of its current value."""
        return all(expected.errors[-1] >= (1.0 - share) * self.now for expected in self.motions)


def expected_gain(
    posterior: Posterior,
    region: ArrayLike,
    motions: Mapping[str, ArrayLike],
    pairs: Sequence[int],
    rng: np.random.Generator,
) -> Forecast:
    """Predict the error over a region (t, d) after further pairs of each motion, from their poses alone.

    Args:
        posterior: the current posterior.
        region: poses (t, d) at which the model is to be accurate.
        motions: poses (n, d) by name, e.g. of `candidate_motions`; pairs are sampled from them with replacement.
        pairs: numbers of further pairs, ascending.
        rng: random generator of the samples.

    Raises:
        SettingError: there is no motion, one without poses, no region, or `pairs` do not ascend from at least 1.
    """
    counts = tuple(pairs)
    if not counts or counts[0] < 1 or any(a >= b for a, b in pairwise(counts)):
        raise SettingError(f"pairs must ascend from at least 1, got {counts}")
    if not motions:
        raise SettingError("there is no motion to speak of")
    design = ExperimentDesign(posterior, region)
    expected: list[ExpectedError] = []
    for name, poses in motions.items():
        pool = rows(name, poses, posterior.joints)
        if not len(pool):
            raise SettingError(f"the motion {name!r} holds no pose")
        expected.append(ExpectedError(name, _errors(design, posterior.roots(pool), counts, rng)))
    expected.sort(key=lambda motion: motion.errors[-1])
    return Forecast(design.error, design.least_error, counts, tuple(expected))


def candidate_motions(
    seen: ArrayLike,
    lower: ArrayLike,
    upper: ArrayLike,
    rng: np.random.Generator,
    *,
    names: Sequence[str] | None = None,
    together: int = 1,
    count: int = 300,
) -> dict[str, FloatArray]:
    """Return poses (count, d) of the motions with which an arm could continue.

    "as so far" is spread like the poses seen, "all joints" over the whole ranges. The others move one joint, or
    `together` of them, over the range and leave the rest as in "as so far"; they are named after the joints.

    Args:
        seen: poses (n, d) of the pairs so far [rad, m].
        lower, upper: the joints' limits (d,).
        rng: random generator of the poses.
        names: names of the joints; None counts them from 1.
        together: number of joints that the other motions move.
        count: number of poses per motion.

    Raises:
        SettingError: no poses seen, limits or names do not fit, or `together` or `count` are below 1.
    """
    poses = np.atleast_2d(np.asarray(seen, dtype=np.float64))
    d = poses.shape[1]
    poses, low, high = rows("seen", poses, d), vector("lower", lower, d), vector("upper", upper, d)
    called = [f"joint {k + 1}" for k in range(d)] if names is None else list(names)
    if not len(poses) or not (low < high).all() or len(called) != d:
        raise SettingError("poses seen, limits with lower < upper and a name for each joint are needed")
    if not (1 <= together <= d and count >= 1):
        raise SettingError(f"together must be from 1 to {d} and count at least 1, got {together} and {count}")
    like = np.clip(_resampled(poses, count, rng), low, high)
    everywhere = rng.uniform(low, high, (count, d))
    found = {SAME: like, ALL: everywhere}
    for joints in combinations(range(d), together):
        moved = like.copy()
        moved[:, joints] = everywhere[:, joints]
        found[" and ".join(called[k] for k in joints)] = moved
    return found


def _errors(
    design: ExperimentDesign, pool: FloatArray, counts: tuple[int, ...], rng: np.random.Generator
) -> tuple[float, ...]:
    # Six random designs per motion, averaged: a single one depends on chance where the pairs are few.
    drawn = rng.integers(0, len(pool), (6, counts[-1]))
    errors: list[float] = []
    for count in counts:
        # A pose that occurs k times is worth one pair there with the noise over √k.
        times = [np.bincount(row[:count], minlength=len(pool)) for row in drawn]
        errors.append(float(np.mean([design.error_after(pool * np.sqrt(k)[:, None, None]) for k in times])))
    return tuple(errors)


def _resampled(poses: FloatArray, count: int, rng: np.random.Generator) -> FloatArray:
    """Return poses (count, d) distributed like those given: each joint's spread, and the correlations of the joints.

    A smoothed bootstrap that keeps the covariance (Silverman and Young 1987), with Silverman's Gaussian bandwidth, of
    the joints' normal scores; so smoothing does not carry joints beyond the range seen. A share of the poses equal to
    the part of the correlations that is due to chance has its joints sampled independently.
    """
    n, d = poses.shape
    ranked = np.sort(poses, axis=0)
    places = cast(FloatArray, np.linspace(0.5 / n, 1.0 - 0.5 / n, n))
    scores = cast(FloatArray, ndtri(places))[poses.argsort(axis=0).argsort(axis=0)]
    width = (4.0 / ((d + 2.0) * n)) ** (1.0 / (d + 4.0))
    picked = np.repeat(rng.integers(0, n, (3, count, 1)), d, axis=2)
    apart = rng.random(count) < _chance_in_correlations(scores)
    picked[:, apart] = rng.integers(0, n, (3, int(apart.sum()), d))
    drawn, one, other = scores[picked, np.arange(d)]
    # Differences of two poses over √2 have the poses' covariance, whatever its rank.
    smooth = (drawn + width * (one - other) / np.sqrt(2.0)) / np.sqrt(1.0 + width**2)
    shares = cast(FloatArray, ndtr(smooth))
    like = np.empty((count, d))
    for joint in range(d):
        like[:, joint] = np.interp(shares[:, joint], places, ranked[:, joint])
    return like


def _chance_in_correlations(scores: FloatArray) -> float:
    """Return the share of the squared correlations of scores (n, d) that independent joints would show too, in 0..1.

    It is the optimal shrinkage of correlations towards zero (Schäfer and Strimmer 2005, target "D").
    """
    n, d = scores.shape
    if n < 3 or d == 1:
        return 1.0
    centred = scores - scores.mean(axis=0)
    centred /= np.sqrt(np.square(centred).sum(axis=0))
    squares = np.square((centred.T @ centred)[~np.eye(d, dtype=np.bool_)])
    variances = np.square(1.0 - squares) / (n - 1.0)
    by_chance, shown = float(variances.sum()), float(squares.sum())
    return by_chance / shown if by_chance < shown else 1.0
