"""Whether there is enough data: what further pairs of which motion would still gain."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import ArrayLike

from kbmaps.arrays import FloatArray, rows, vector
from kbmaps.errors import SettingError
from kbmaps.experiment_design import ExperimentDesign
from kbmaps.posterior import Posterior

# Designs drawn from each motion and averaged: one alone is luck where the pairs are few.
_DESIGNS = 6
SAME, ALL = "as so far", "all joints"


@dataclass(frozen=True)
class ExpectedError:
    """What one kind of motion would lead to.

    Attributes:
        motion: its name.
        errors: expected mean error [m] after each number of pairs asked for.
    """

    motion: str
    errors: tuple[float, ...]


@dataclass(frozen=True)
class Forecast:
    """What further pairs would still gain over a region.

    Attributes:
        now: expected mean error [m].
        least: the part of it [m] that no pair mends, since the model cannot follow the arm.
        pairs: numbers of further pairs, as asked for.
        motions: what they would lead to, the motion that gains most first.
    """

    now: float
    least: float
    pairs: tuple[int, ...]
    motions: tuple[ExpectedError, ...]

    def error_after(self, motion: str, pairs: int) -> float:
        """Expected mean error [m]. Raises SettingError: it was not asked for."""
        for expected in self.motions:
            if expected.motion == motion and pairs in self.pairs:
                return expected.errors[self.pairs.index(pairs)]
        raise SettingError(f"{pairs} pairs of the motion {motion!r} are not in the forecast")

    def is_enough(self, share: float = 0.1) -> bool:
        """Whether no motion would lower the error by more than a share of what it is now."""
        return all(expected.errors[-1] >= (1.0 - share) * self.now for expected in self.motions)


def expected_gain(
    posterior: Posterior,
    region: ArrayLike,
    motions: Mapping[str, ArrayLike],
    pairs: Sequence[int],
    rng: np.random.Generator,
) -> Forecast:
    """The error over a region (t, d) after further pairs of each motion, foretold from where they would be taken.

    Args:
        motions: poses (n, d) by name, e.g. of `candidate_motions`; pairs are drawn from them with replacement.
        pairs: how many further pairs, ascending.

    Raises:
        ShapeError, NonFiniteError
        SettingError: there is no motion, one without poses, no region, or `pairs` do not ascend from at least 1.
    """
    counts = tuple(pairs)
    if not counts or counts[0] < 1 or any(a >= b for a, b in zip(counts, counts[1:], strict=False)):
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
    """Poses (count, d) of the motions that an arm could go on with.

    "as so far" is spread like the poses seen, "all joints" over the whole ranges. The others move one joint, or
    `together` of them, over the range and leave the rest as "as so far" has them; they are named after the joints.

    Args:
        seen: poses (n, d) of the pairs so far [rad, m].
        lower, upper: the joints' limits (d,).
        names: of the joints; None counts them from 1.

    Raises:
        ShapeError, NonFiniteError
        SettingError: nothing was seen, limits or names do not fit, or `together` or `count` are below 1.
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
    anywhere = rng.uniform(low, high, (count, d))
    found = {SAME: like, ALL: anywhere}
    for joints in combinations(range(d), together):
        moved = like.copy()
        moved[:, joints] = anywhere[:, joints]
        found[" and ".join(called[k] for k in joints)] = moved
    return found


def _errors(
    design: ExperimentDesign, pool: FloatArray, counts: tuple[int, ...], rng: np.random.Generator
) -> tuple[float, ...]:
    drawn = rng.integers(0, len(pool), (_DESIGNS, counts[-1]))
    return tuple(float(np.mean([design.error_after(pool[row[:count]]) for row in drawn])) for count in counts)


def _resampled(poses: FloatArray, count: int, rng: np.random.Generator) -> FloatArray:
    """Poses (count, d) like those given, with the same mean and covariance but not the same ones.

    A smoothed bootstrap that keeps the covariance (Silverman and Young 1987), with Silverman's Gaussian bandwidth.
    """
    n, d = poses.shape
    mean = poses.mean(axis=0)
    width = (4.0 / ((d + 2.0) * n)) ** (1.0 / (d + 4.0))
    picked = poses[rng.integers(0, n, count)] - mean
    partners = poses[rng.integers(0, n, (count, 2))]
    # Differences of two poses over √2 have the poses' covariance, whatever its rank.
    jitter = (partners[:, 0] - partners[:, 1]) / np.sqrt(2.0)
    return mean + (picked + width * jitter) / np.sqrt(1.0 + width**2)
