"""Choose the content of extended.toml: only parts that are surely better on another recording."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from bodyschema.diagnosis.fit.background import Background
from bodyschema.diagnosis.fit.fit import Fit, amount_columns, solved
from bodyschema.diagnosis.search.held_out import Blocks, held_out_errors
from bodyschema.diagnosis.unnamed.smooth import SmoothModel
from bodyschema.effects import Effect, Motion, PipelineRun
from bodyschema.effects.motion import crossed
from bodyschema.interfaces.records import FloatArray


class _Settings:
    # Number of long blocks of time, each of which is left out once. In short ones a walk stays near where it was.
    parts = 10
    surely = 0.95  # one-sided probability of the t-test
    poses = 400  # number of new poses


def stored(candidates: Sequence[Fit], markers: NDArray[np.bool_]) -> Fit:
    """Return the fit that is surely best on another recording.

    The expected squared error there is the error on long held-out blocks of time, plus the variance between fits
    without one of them on poses that recombine the readings of the joints. A fit has to be better than a simpler one by
    Student's t-test of the blocks.

    Args:
        candidates: fits of the same observations, the simplest first.
        markers: True for fixes (n,) that are probably the marker.
    """
    best, *others = (_Generalisation.of(fit, markers) for fit in candidates)
    for other in others:
        if other.is_better_than(best):
            best = other
    return best.fit


def is_better_with(model: SmoothModel, simpler: Fit, markers: NDArray[np.bool_], blocks: Blocks) -> bool:
    """Return True if a fit with a smooth model is surely better on another recording than a simpler fit.

    Args:
        blocks: blocks held out from the functions of the model.
    """
    before, after = _Generalisation.of(simpler, markers), _Generalisation.of(model.fit, markers)
    left = model.fit.observations.x - model.fit.predicted + model.in_sample_change
    gains = _sums(held_out_errors(simpler, blocks), markers) - _sums(left, markers)
    return replace(after, squares=before.squares - gains).is_better_than(before)


@dataclass(frozen=True, eq=False)
class _Generalisation:
    """Expected errors of a fit on another recording."""

    fit: Fit
    squares: FloatArray  # sum of squared held-out errors in each long block, over the number of all rows (blocks,) [m²]
    variance: float  # mean squared distance between its predictions of new poses [m²]

    @classmethod
    def of(cls, fit: Fit, markers: NDArray[np.bool_]) -> _Generalisation:
        errors = fit.observations.x - fit.predicted
        if not len(fit.precision):
            return cls(fit, _sums(errors, markers), 0.0)
        parts, columns, here = _long_blocks(len(errors)).of_row, fit.columns, fit.derivatives
        flat, left = columns.reshape(fit.weighted_residuals.size, -1), fit.weighted_residuals.ravel()
        without_history = fit.observations.without_history
        free = without_history.whitened(here[:, :, : fit.amounts]) * fit.root_weights[:, :, None]
        normal = flat.T @ flat + np.diag(fit.precision) * fit.noise.sigma**2
        gradient, changes = flat.T @ left, []
        for part in np.unique(parts):
            own = parts == part
            rows = columns[own].reshape(-1, columns.shape[2])
            change = solved(normal - rows.T @ rows, gradient - rows.T @ fit.weighted_residuals[own].ravel())
            if fit.observations.play_covariance is not None:
                # As stored: both sides of the play determine the place.
                missed = (without_history.residuals(fit.predicted + here @ change) * fit.root_weights)[~own].ravel()
                rest = free[~own].reshape(len(missed), fit.amounts)
                change[: fit.amounts] += solved(rest.T @ rest, rest.T @ missed)
            errors[own] -= here[own] @ change
            changes.append(change)
        elsewhere = _columns(fit, fit.simulation_with_tolerances.run(_new_poses(fit.observations.motion)))
        moved = elsewhere @ np.transpose(changes - np.mean(changes, axis=0))
        variance = (1.0 - 1.0 / len(changes)) * float(np.square(moved).sum(axis=(1, 2)).mean())
        return cls(fit, _sums(errors, markers), variance)

    def is_better_than(self, simpler: _Generalisation) -> bool:
        """Return True if this fit is surely better elsewhere."""
        gains = simpler.squares - self.squares
        margin = float(np.std(gains, ddof=1)) * np.sqrt(len(gains)) * stdtrit(len(gains) - 1, _Settings.surely)
        return float(gains.sum()) - margin > max(self.variance - simpler.variance, 0.0)


def predicted_pose_covariance(fit: Fit) -> FloatArray | None:
    """Return the covariance (6, 6) of the predicted pose of the marker, or None if nothing was fitted.

    It is that of all fitted numbers together, in the mean of recorded poses and without the instrument's noise: x, y,
    z [m²] in the measurement frame, then rotations about its axes [rad²].
    """
    if not fit.covariance.size:
        return None
    motion = fit.observations.motion
    motion = motion.some(np.arange(0, len(motion), -(-len(motion) // _Settings.poses)))
    simulation = fit.simulation_with_tolerances
    own = [effect for effect in simulation.effects if _is_of_pose(effect)]
    arm = replace(simulation, effects=tuple(own), residual=None)
    # The marker, and points 1 m from it along the axes of its link, which rotate about it.
    offset_points = [Effect.at(arm.robot, "tool_offset", values=axis) for axis in np.eye(3)]
    marker, *points = (arm.with_effects([*own, *more]).run(motion) for more in ([], *([one] for one in offset_points)))
    moved = _pose_columns(fit, marker)
    turned = 0.5 * sum(
        crossed((point.measured - marker.measured)[:, :, None], _pose_columns(fit, point) - moved) for point in points
    )
    columns = np.concatenate([moved, turned], axis=1)
    return np.tensordot(columns @ fit.covariance, columns, axes=((0, 2), (0, 2))) / len(motion)


def _is_of_pose(effect: Effect) -> bool:
    """Return True if an effect moves the arm, the marker or the camera's mount, but not the reported positions."""
    if effect.kind.stage == "camera":
        return effect.pose is not None and not effect.kind.begins
    return not effect.kind.drifts


def _pose_columns(fit: Fit, run: PipelineRun) -> FloatArray:
    """Return derivatives (n, 3, p) [m] of a run in the order of `Fit.covariance`; 0 for effects that it lacks."""
    columns = [_columns(fit, run), *(run.by_shape(effect) for effect in fit.causes if effect.shapes)]
    numbers = [(effect, len(effect.amounts)) for effect in fit.simulation.effects]
    numbers += [(effect, len(effect.shapes)) for effect in fit.causes]
    counted = np.array([_is_of_pose(effect) for effect, count in numbers for _ in range(count)], dtype=bool)
    return np.concatenate(columns, axis=2) * np.insert(
        counted, fit.amounts, np.ones(len(fit.tolerance_amounts), dtype=bool)
    )


def _long_blocks(rows: int) -> Blocks:
    return Blocks.cut(rows, _Settings.parts)


def _sums(errors: FloatArray, markers: NDArray[np.bool_]) -> FloatArray:
    """Return the sum of squared errors (n, 3) in each long block, divided by the number of rows that count [m²]."""
    squares = np.where(markers, np.square(errors).sum(axis=1), 0.0)
    return _long_blocks(len(errors)).sums(squares) / max(float(markers.sum()), 1.0)


def _new_poses(motion: Motion) -> Motion:
    """Return a motion in which the readings of each joint are permuted independently."""
    rng, rows = np.random.default_rng(0), np.linspace(0, len(motion) - 1, min(len(motion), _Settings.poses)).astype(int)
    q = np.stack([rng.permutation(own)[rows] for own in motion.q.T], axis=1)
    return replace(motion, q=q, t=None if motion.t is None else motion.t[rows], segment=motion.segment[rows])


def _columns(fit: Fit, run: PipelineRun) -> FloatArray:
    """Return derivatives (n, 3, p) [m] of a run on another motion, in the order of `derivatives`."""
    background = Background(run, fit.observations.whitening, fit.background.scales)
    return np.concatenate([amount_columns(run, fit.simulation.effects), background.columns], axis=2)
