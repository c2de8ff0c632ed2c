"""Structure that no effect fits: whether there is any, on which joints it depends, and a smooth model of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import stats

from interfaces.records import FloatArray

from .fit import Fit

# Structure has to be so improbable by chance, over all groups of features that are looked at.
SIGNIFICANT = 1e-4
_HARMONICS = 2
# Of the joints that a model of the structure takes up, each has to bring this share of what it explains.
_BRINGS = 0.03


@dataclass(frozen=True, eq=False)
class Leftover:
    """What is left when all causes have been named.

    Attributes:
        p_value: of so much structure by chance.
        joints: on which joints it depends, by their places in q.
        with_time: whether it depends on time.
        explained: what smooth functions of these joints predict (n, 3) [m].
    """

    p_value: float
    joints: tuple[int, ...]
    with_time: bool
    explained: FloatArray

    @property
    def is_there(self) -> bool:
        """Whether there is any structure."""
        return self.p_value < SIGNIFICANT


def leftover(fit: Fit) -> Leftover:
    """What smooth functions of the joint angles, two at a time, and of time explain of what a fit has left."""
    groups = _groups(fit)
    gains, dofs = zip(*(_explained(fit, columns) for _, columns in groups), strict=True)
    p_values = np.array([stats.chi2.sf(gain, dof) if dof else 1.0 for gain, dof in zip(gains, dofs, strict=True)])
    p_value = float(min(1.0, p_values.min() * len(p_values)))
    if p_value >= SIGNIFICANT:
        return Leftover(p_value, (), False, np.zeros_like(fit.residuals))
    members, explained = _selected(fit, groups)
    joints = sorted({joint for member in members for joint in member if joint >= 0})
    return Leftover(p_value, tuple(joints), any(-1 in member for member in members), explained)


def _groups(fit: Fit) -> list[tuple[tuple[int, ...], FloatArray]]:
    """Features (n, m) of one joint, of two joints together, and of time (-1)."""
    q, prismatic = fit.observations.motion.q, fit.simulation.robot.chain.prismatic
    span = np.where(prismatic, np.maximum(np.ptp(q, axis=0), 1e-9) / np.pi, 1.0)
    angles = (q - q.mean(axis=0)) / span
    moving = [k for k in range(q.shape[1]) if np.ptp(q[:, k]) > 1e-4]
    single = {k: _harmonics(angles[:, k]) for k in moving}
    groups = [((k,), features) for k, features in single.items()]
    for i, j in ((i, j) for i in moving for j in moving if i < j):
        both = single[i][:, :2, None] * single[j][:, None, :2]
        groups.append(((i, j), both.reshape(len(q), -1)))
    clock = fit.observations.motion.clock
    groups.append(((-1,), _harmonics(np.pi * (clock - clock[0]) / max(float(clock[-1] - clock[0]), 1e-9))))
    return groups


def _harmonics(angle: FloatArray) -> FloatArray:
    parts = [f(k * angle) for k in range(1, _HARMONICS + 1) for f in (np.sin, np.cos)]
    return np.stack(parts, axis=1)


def _columns(fit: Fit, features: FloatArray) -> FloatArray:
    """Each feature along each axis of the measurement frame (n, 3, 3 m), whitened, weighted."""
    moved = features[:, None, :, None] * np.eye(3)[:, None, :]
    return fit.weighted(moved.reshape(len(features), 3, -1))


def _explained(fit: Fit, features: FloatArray) -> tuple[float, int]:
    beside, rank = _beside(fit, _columns(fit, features))
    rise = float(np.square(beside.T @ fit.left.ravel()).sum())
    return rise / fit.noise.sigma**2, rank


def _beside(fit: Fit, columns: FloatArray) -> tuple[FloatArray, int]:
    """An orthonormal basis (3 n, r) of columns (n, 3, k) beside what the fit can change."""
    basis = fit.orthogonal.reshape(fit.left.size, -1)
    flat = columns.reshape(fit.left.size, -1)
    flat = flat / np.maximum(np.linalg.norm(flat, axis=0), 1e-300)
    beside = flat - basis @ (basis.T @ flat)
    left, values, _ = np.linalg.svd(beside, full_matrices=False)
    told = values > 1e-5
    return left[:, told], int(told.sum())


def _selected(fit: Fit, groups: list[tuple[tuple[int, ...], FloatArray]]) -> tuple[list[tuple[int, ...]], FloatArray]:
    """The groups that explain most, added one by one while each brings its share; and what they predict (n, 3) [m]."""
    target = fit.left.ravel()
    chosen: list[tuple[int, ...]] = []
    basis = np.empty((target.size, 0))
    total = 0.0
    available = {members: _beside(fit, _columns(fit, features))[0] for members, features in groups}
    while available:
        best, most, best_part = None, 0.0, basis
        for members, part in available.items():
            fresh = part - basis @ (basis.T @ part)
            left, values, _ = np.linalg.svd(fresh, full_matrices=False)
            left = left[:, values > 1e-4]
            gain = float(np.square(left.T @ target).sum()) / fit.noise.sigma**2 - 2.0 * left.shape[1]
            if gain > most:
                best, most, best_part = members, gain, left
        if best is None or most < max(_BRINGS * total, 30.0):
            break
        chosen.append(best)
        basis = np.concatenate([basis, best_part], axis=1)
        total += most
        del available[best]
    whitened = (basis @ (basis.T @ target)).reshape(fit.left.shape) / np.maximum(fit.root_weights, 1e-6)
    return chosen, np.linalg.solve(fit.observations.whitening, whitened[:, :, None])[:, :, 0]
