"""Ways to differ that no effect of the table covers: any smooth error of a joint, a link, the tool or the cameras.

Each is a family of linear functions: what moves, times what it may depend on. They compete with the named effects, so
that one of these is not named where something else is at work.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from effects import Effect, Simulated
from interfaces.records import FloatArray

from .fit import Fit
from .held_out import Blocks, scores_p_value
from .search import nats

_HARMONICS, _TIMES = 5, 4
TIME = -1
# What has no name has to be so much more probable than what has one [nats].
_NO_NAME = 8.0
# What one of its numbers costs [nats].
_NUMBER = 2.0
# Directions of a family's columns of which less is left, as a share of the strongest and of the whole, tell nothing.
_TOLD, _LEFT = 1e-6, 1e-7
# Whether blocks of time agree is asked of so many of a family's directions.
_STRONGEST = 4
_RIDGE = 1e-6


@dataclass(frozen=True, eq=False)
class Family:
    """One way to differ.

    Attributes:
        what: in a few words.
        at: the joints at which it acts, by their places in q.
        drivers: the joints on which it may depend; `TIME` for time.
        columns: derivatives (n, 3, p) of what is measured by its numbers [m].
    """

    what: str
    at: tuple[int, ...]
    drivers: tuple[int, ...]
    columns: Callable[[Simulated], FloatArray]


def families(run: Simulated) -> list[Family]:
    """All that this motion can show."""
    robot, motion = run.simulation.robot, run.motion
    joints = [k for k in range(motion.q.shape[1]) if np.ptp(motion.q[:, k]) > 1e-4]
    names = robot.joints
    found = []
    for k in joints:
        for j in joints:
            found.append(Family(f"an error of {names[k]} that depends on {names[j]}", (k,), (j,), _of_joint(k, j)))
            if j != k:
                what = f"an error of {names[k]} that depends on itself and {names[j]} together"
                found.append(Family(what, (k,), (k, j), _of_both(k, j)))
        if motion.t is not None:
            found.append(Family(f"an error of {names[k]} that changes with time", (k,), (TIME,), _of_time(k)))
            found.append(Family(f"the link before {names[k]} changes with time", (k,), (TIME,), _link_over_time(k)))
        if run.simulation.gravity.known:
            what = f"what carries {names[k]} gives under the arm's weight"
            found.append(Family(what, (k,), tuple(j for j in joints if j >= k), _link_under_weight(k)))
    if motion.t is not None:
        found.append(Family("the tool changes with time", (), (TIME,), _tool_over_time))
        found.append(Family("the camera moves with time", (), (TIME,), _camera_over_time))
    found.append(Family("an error that depends on where the marker is in the image", (), tuple(joints), _in_image))
    return found


def _of_joint(k: int, j: int) -> Callable[[Simulated], FloatArray]:
    return lambda run: _moved(run.by_joint[:, :, [k]], _with_one(_harmonics(run, j, _HARMONICS)))


def _of_both(k: int, j: int) -> Callable[[Simulated], FloatArray]:
    def columns(run: Simulated) -> FloatArray:
        both = _harmonics(run, k, 2)[:, :, None] * _harmonics(run, j, 2)[:, None, :]
        alone = [_harmonics(run, k, 2), _harmonics(run, j, 2)]
        return _moved(run.by_joint[:, :, [k]], _with_one(np.concatenate([*alone, both.reshape(len(both), -1)], axis=1)))

    return columns


def _of_time(k: int) -> Callable[[Simulated], FloatArray]:
    return lambda run: _moved(run.by_joint[:, :, [k]], _times(run, 2 * _TIMES))


def _link(run: Simulated, k: int) -> FloatArray:
    simulation = run.simulation
    return run.columns(Effect.at(simulation.robot, "link_geometry", simulation.robot.joints[k]))


def _link_over_time(k: int) -> Callable[[Simulated], FloatArray]:
    return lambda run: _moved(_link(run, k), _times(run, _TIMES))


def _link_under_weight(k: int) -> Callable[[Simulated], FloatArray]:
    def columns(run: Simulated) -> FloatArray:
        link = _link(run, k)
        return np.concatenate([link, _moved(link[:, :, 3:], run.loads[:, k])], axis=2)

    return columns


def _tool_over_time(run: Simulated) -> FloatArray:
    return _moved(run.columns(Effect.at(run.simulation.robot, "tool_offset")), _times(run, _TIMES))


def _camera_over_time(run: Simulated) -> FloatArray:
    return _moved(run.columns(Effect.at(run.simulation.robot, "camera_pose")), _times(run, _TIMES))


def _in_image(run: Simulated) -> FloatArray:
    x = run.measured
    depth = np.where(np.abs(x[:, 2]) > 1e-3, x[:, 2], 1e-3)
    scale = float(np.median(np.abs(depth)))
    place = np.stack([x[:, 0] / depth, x[:, 1] / depth, depth / scale - 1.0], axis=1)
    products = [place[:, [i]] * place[:, [j]] for i in range(3) for j in range(i, 3)]
    cubes = [place[:, [i]] * place[:, [j]] * place[:, [k]] for i in range(3) for j in range(i, 3) for k in range(j, 3)]
    amounts = np.concatenate([place, *products, *cubes], axis=1)
    return _moved(np.broadcast_to(np.eye(3), (len(x), 3, 3)), _with_one(amounts))


def _harmonics(run: Simulated, j: int, count: int) -> FloatArray:
    """Sines and cosines (n, 2 count) of a joint's reading; of a slide, of its path as half a turn."""
    q = run.motion.q[:, j]
    if run.simulation.robot.chain.prismatic[j]:
        q = np.pi * (q - q.min()) / max(float(np.ptp(q)), 1e-9)
    return np.concatenate([f(h * q)[:, None] for h in range(1, count + 1) for f in (np.sin, np.cos)], axis=1)


def _times(run: Simulated, count: int) -> FloatArray:
    """One, and cosines (n, count + 1) over the time of the recording."""
    clock = run.motion.clock
    share = (clock - clock[0]) / max(float(clock[-1] - clock[0]), 1e-9)
    return np.cos(np.pi * share[:, None] * np.arange(count + 1))


def _with_one(amounts: FloatArray) -> FloatArray:
    """The error may have a part that depends on nothing: it belongs to the same cause."""
    return np.concatenate([np.ones((len(amounts), 1)), amounts], axis=1)


def _moved(moves: FloatArray, amounts: FloatArray) -> FloatArray:
    """Every move (n, 3, a) by every amount (n, b): (n, 3, a b)."""
    return (moves[:, :, :, None] * amounts[:, None, None, :]).reshape(len(moves), 3, -1)


def _unit_columns(start: Fit, family: Family) -> FloatArray:
    """A family's columns (3 n, p), whitened and as long as one."""
    columns = start.observations.whitened(family.columns(start.run)).reshape(start.left.size, -1)
    columns /= np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    return columns


class Unknowns:
    """All families as they stand beside fits of the same observations.

    Their columns are those of the aligned simulation: what is unknown is small, and so is what the causes change.
    """

    def __init__(self, start: Fit) -> None:
        self.families = families(start.run)
        self._columns = [_unit_columns(start, family) for family in self.families]
        self._doubt = float(np.log(len(self.families))) + _NO_NAME

    def beside(self, fit: Fit, others: Sequence[int] = ()) -> tuple[FloatArray, FloatArray]:
        """An orthonormal basis (3 n, r) of what `fit` and some families can change, and what they leave (3 n,)."""
        basis = fit.orthogonal.reshape(fit.left.size, -1)
        for index in others:
            basis = np.concatenate([basis, self._fresh(fit, basis, index)], axis=1)
        left = fit.left.ravel()
        return basis, left - basis @ (basis.T @ left)

    def best(self, fit: Fit, others: Sequence[int] = ()) -> tuple[int, float]:
        """The family that is worth most beside a fit and other families, and how much [nats]."""
        basis, left = self.beside(fit, others)
        weights = np.repeat(fit.root_weights[:, 0], 3)[:, None]
        rss, rows = float(left @ left), float(fit.noise.weights.sum())
        worths = []
        for columns in self._columns:
            own = columns * weights
            onto, toward = basis.T @ own, own.T @ left
            inner = own.T @ own - onto.T @ onto
            values, vectors = np.linalg.eigh(inner)
            told = values > _TOLD * max(float(values.max()), 1e-12)
            told &= values > _LEFT
            explained = float(np.square(vectors[:, told].T @ toward / np.sqrt(values[told])).sum())
            gain = -3.0 * rows * float(np.log1p(-min(explained / rss, 0.999999)))
            worths.append(0.5 * gain - _NUMBER * int(told.sum()))
        index = int(np.argmax(worths))
        return index, worths[index] - self._doubt

    def gain(self, fit: Fit, chosen: Sequence[int]) -> tuple[float, int]:
        """Twice the log-likelihood that families bring beside a fit, and with how many numbers."""
        before = fit.left.ravel() - fit.orthogonal.reshape(fit.left.size, -1) @ (
            fit.orthogonal.reshape(fit.left.size, -1).T @ fit.left.ravel()
        )
        basis, after = self.beside(fit, chosen)
        rows = float(fit.noise.weights.sum())
        share = float(after @ after) / max(float(before @ before), 1e-300)
        return -3.0 * rows * float(np.log(max(share, 1e-12))), basis.shape[1] - fit.orthogonal.shape[2]

    def size(self, fit: Fit, chosen: Sequence[int]) -> float:
        """How much families explain (RMS) of what a fit leaves, in units of the stated noise."""
        basis, _ = self.beside(fit, chosen)
        own = basis[:, fit.orthogonal.shape[2] :]
        return float(np.sqrt(np.square(own.T @ fit.left.ravel()).sum() / fit.left.size))

    def predicted(self, fit: Fit, chosen: Sequence[int], blocks: Blocks) -> tuple[FloatArray, FloatArray]:
        """What families predict of what a fit leaves (n, 3) [m]: of all rows, and of rows that were not fitted."""
        basis, _ = self.beside(fit, chosen)
        own = basis[:, fit.orthogonal.shape[2] :]
        left = fit.left.ravel()
        explained = own @ (own.T @ left)
        held_out = np.zeros_like(left)
        folds = np.repeat(blocks.fold, 3)
        for fold in np.unique(folds):
            rows = folds == fold
            inner = basis[~rows].T @ basis[~rows] + _RIDGE * np.eye(basis.shape[1])
            amounts = np.linalg.solve(inner, basis[~rows].T @ left[~rows])
            held_out[rows] = basis[rows] @ amounts
        weights = np.maximum(fit.root_weights, 1e-6)[:, :, None]
        both = np.stack([explained, held_out], axis=1).reshape(*fit.left.shape, 2) / weights
        metres = np.asarray(np.linalg.solve(fit.observations.whitening, both), dtype=np.float64)
        return metres[:, :, 0], metres[:, :, 1]

    def agreed(self, fit: Fit, others: Sequence[int], index: int) -> float:
        """What a family is worth by the agreement of blocks of time [nats]."""
        basis, left = self.beside(fit, others)
        fresh = self._fresh(fit, basis, index)
        strongest = np.argsort(-np.abs(fresh.T @ left))[:_STRONGEST]
        columns = fresh[:, strongest].reshape(*fit.left.shape, -1)
        chance = scores_p_value(columns, left.reshape(fit.left.shape), Blocks.cut(len(fit.left)))
        # The strongest of so many were chosen: each costs as one among all.
        gain = float(stats.chi2.isf(max(chance, 1e-290), len(strongest)))
        return nats(gain, len(strongest)) - len(strongest) * float(np.log(fresh.shape[1])) - self._doubt

    def _fresh(self, fit: Fit, basis: FloatArray, index: int) -> FloatArray:
        """An orthonormal basis (3 n, r) of what a family changes beside a basis."""
        columns = self._columns[index] * np.repeat(fit.root_weights[:, 0], 3)[:, None]
        columns = columns - basis @ (basis.T @ columns)
        left, values, _ = np.linalg.svd(columns, full_matrices=False)
        return left[:, values > np.sqrt(_LEFT)]
