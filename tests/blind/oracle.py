"""Distinguishability of effects for an observer who knows the truth, in units of the noise.

All computations use positions free of noise. The distance of an alternative from the truth is the rise of chi-square
when the alternative is fitted in place of the true effect, with all free parameters.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from bodyschema.effects import EFFECT_TYPES, Effect, Motion, Simulation
from bodyschema.robot.description import RobotDescription

from .arrays import FloatArray

ROUNDS = 8
CONVERGED = 1e-4
MOMENTS = 40  # not at the ends, where a sudden effect is equivalent to a constant one
CYCLES = np.arange(2.0, 101.0)
WIDTHS = np.geomspace(2e-4, 0.1, 8)
SETTLED = (0.03, 0.1, 0.3, 1.0, 3.0)
MEMORIES = (0.0, 0.2, 0.4, 0.6)
NEAREST = 6  # rivals that are fitted in full
WIDE_ROWS, STOPS_EVERY = 400, 4
IN_FRONT_M = 0.15


@dataclass(frozen=True, eq=False)
class Fitted:
    """Effects with the numbers that fit a target best, and chi-square of the fit."""

    effects: tuple[Effect, ...]
    chi2: float


@dataclass(frozen=True, eq=False)
class Scene:
    """A motion of a robot, watched with known noise.

    Attributes:
        whitening: of each position (n, 3, 3) [1/m].
        rounding: covariance (n, 3, 3) [m²] that comes from readings in whole ticks, and what they scatter before.
    """

    simulation: Simulation
    motion: Motion
    whitening: FloatArray
    rounding: FloatArray

    @classmethod
    def of(cls, robot: RobotDescription, motion: Motion, covariance: FloatArray, scatter: float) -> Scene:
        """Return a motion measured with this noise covariance (n, 3, 3) [m²] and this noise of the readings.

        Args:
            scatter: 1-sigma of readings before they are rounded to whole ticks [ticks].
        """
        simulation = Simulation(robot)
        moved = simulation.run(motion).by_joint * (_ticks(motion.q) * np.sqrt(1.0 / 12.0 + scatter**2))
        rounding = moved @ np.swapaxes(moved, 1, 2)
        return cls(simulation, motion, np.linalg.inv(np.linalg.cholesky(covariance + rounding)), rounding)

    def positions(self, effects: Sequence[Effect]) -> FloatArray:
        """Return the noise-free measured positions (n, 3) [m]."""
        return self.simulation.with_effects(effects).positions(self.motion)

    def whitened(self, x: FloatArray) -> FloatArray:
        """Scale (n, 3) or (n, 3, p) [m] to units of the noise and flatten: (3 n,) or (3 n, p)."""
        columns = x[:, :, None] if x.ndim == 2 else x
        flat = (self.whitening @ columns).reshape(3 * len(x), columns.shape[2])
        return flat[:, 0] if x.ndim == 2 else flat

    def chi2(self, target: FloatArray, effects: Sequence[Effect]) -> float:
        """Return chi-square of the difference between the effects' positions and the target (n, 3) [m]."""
        return float(np.square(self.whitened(target - self.positions(effects))).sum())

    def fitted(self, target: FloatArray, effects: Sequence[Effect]) -> Fitted:
        """Fit the amounts of the effects to the target by Gauss-Newton steps."""
        best = Fitted(tuple(effects), self.chi2(target, effects))
        for _ in range(ROUNDS):
            columns = self.columns(best.effects)
            if not columns.shape[1]:
                return best
            step = solved(columns, self.whitened(target - self.positions(best.effects)))
            before = best.chi2
            for shorter in (1.0, 0.3, 0.05):
                moved = stepped(best.effects, shorter * step)
                tried = Fitted(moved, self.chi2(target, moved))
                if tried.chi2 < best.chi2:
                    best = tried
                    break
            if before - best.chi2 <= CONVERGED * max(best.chi2, 1.0):
                break
        return best

    def columns(self, effects: Sequence[Effect]) -> FloatArray:
        """Return the whitened derivatives (3 n, p) of the measured positions with respect to all amounts."""
        run = self.simulation.with_effects(effects).run(self.motion)
        parts = [run.columns(effect)[:, :, effect.amounts] for effect in effects]
        return self.whitened(np.concatenate(parts, axis=2) if parts else np.empty((len(self.motion), 3, 0)))

    def replaced(self, target: FloatArray, others: Sequence[Effect], true: Effect, effect: Effect) -> Fitted:
        """Fit an effect in place of a true one, at the moment, period, width or time constant that fits best."""
        starts = [effect, self._nearest(target, others, [effect])[0][1]]
        if all(e.parameters[-1].name == "t0" for e in (true, effect)):
            starts.append(effect.with_values(np.append(effect.values[:-1], true.values[-1])))
        return min((self.fitted(target, [*others, start]) for start in starts), key=lambda fit: fit.chi2)

    def rivals(self, target: FloatArray, others: Sequence[Effect], but: Iterable[Effect]) -> list[Fitted]:
        """Return the single effects that fit the target best beside others, fully fitted, the best first."""
        excluded = {effect.key for effect in (*but, *others)}
        ranked = self._nearest(target, others, [e for e in hypotheses(self.simulation) if e.key not in excluded])
        tried = [self.fitted(target, [*others, effect]) for _, effect in ranked[:NEAREST]]
        possible = [fit for fit in tried if fit.effects[-1].is_valid]
        return sorted(possible, key=lambda fit: fit.chi2)

    def _nearest(
        self, target: FloatArray, others: Sequence[Effect], wanted: Sequence[Effect]
    ) -> list[tuple[float, Effect]]:
        """Rank effects to first order by the part of the target that they leave, with their numbers."""
        run = self.simulation.with_effects(others).run(self.motion)
        basis = orthonormal(self.columns(others))
        left = self.whitened(target - run.measured)
        left = left - basis @ (basis.T @ left)
        found = []
        for effect in wanted:
            best: tuple[float, Effect] | None = None
            for shaped in self._shapes(effect, left, basis):
                columns = self.whitened(run.columns(shaped)[:, :, shaped.amounts])
                columns = columns - basis @ (basis.T @ columns)
                amounts = solved(columns, left)
                chi2 = float(np.square(left - columns @ amounts).sum())
                if best is None or chi2 < best[0]:
                    best = (chi2, _with_amounts(shaped, amounts))
            if best is not None:
                found.append(best)
        return sorted(found, key=lambda pair: pair[0])

    def _shapes(self, effect: Effect, left: FloatArray, basis: FloatArray) -> list[Effect]:
        """Return the effect with each moment, period, width or time constant worth a try."""
        clock = self.motion.clock
        match effect.name:
            case "joint_ripple":
                return self._ripples(effect, left, basis)
            case "encoder_jump" | "tool_slip" | "camera_moved":
                moments = np.quantile(clock, np.linspace(0.05, 0.95, MOMENTS))
                return [effect.with_values(np.append(effect.values[:-1], t0)) for t0 in moments]
            case "thermal_drift":
                span = float(clock[-1] - clock[0])
                return [effect.with_values(np.append(np.zeros(3), share * span)) for share in SETTLED]
            case "settling":
                return [effect.with_values(np.array([0.0, memory])) for memory in MEMORIES]
            case "backlash":
                return [effect.with_values(np.array([width])) for width in WIDTHS]
            case _:
                return [effect]

    def _ripples(self, effect: Effect, left: FloatArray, basis: FloatArray) -> list[Effect]:
        """Return ripples with the few numbers of cycles that explain most, found on the joint's own column alone."""
        place = self.simulation.place(effect)
        q = self.motion.q[:, place.joint]
        span = max(float(np.ptp(q)), 1e-6)
        cycles = CYCLES / span if effect.prismatic else CYCLES
        port = self.whitened(self.simulation.run(self.motion).by_joint[:, :, place.joint]).reshape(-1, 3)
        pulled = np.einsum("ni,ni->n", port, left.reshape(-1, 3))
        square = np.square(port).sum(axis=1)
        phases = q[:, None] * cycles * (2.0 * np.pi if effect.prismatic else 1.0)
        power = sum(
            np.square(pulled @ f(phases)) / np.maximum(square @ np.square(f(phases)), 1e-12) for f in (np.sin, np.cos)
        )
        best = cycles[np.argsort(np.asarray(power))[::-1][:6]]
        return [effect.with_values(np.array([0.0, 0.0, float(c)])) for c in best]


def hypotheses(simulation: Simulation) -> list[Effect]:
    """Return one of each effect at each place of a robot, with amounts of zero."""
    robot = simulation.robot
    prismatic = dict(zip(robot.joints, robot.chain.prismatic, strict=True))
    found = []
    for kind in EFFECT_TYPES.values():
        if kind.name == "joint_compliance" and (robot.robot.hold == "torque_free" or not simulation.gravity.known):
            continue
        if (kind.name == "camera_pose" and not robot.camera.pose_known) or (
            kind.name == "tool_offset" and not robot.robot.marker_known
        ):
            continue
        if not kind.at_joint:
            found.append(Effect.at(robot, kind.name))
            continue
        for joint in robot.joints:
            if kind.turns_only and prismatic[joint]:
                continue
            sources = [other for other in robot.joints if other != joint] if kind.takes_source else [None]
            found += [Effect.at(robot, kind.name, joint, source) for source in sources]
    return found


def wide(scene: Scene) -> Scene:
    """Return a path through the joints' whole range, standing for any motion: with stops, turns and uneven times."""
    robot, motion = scene.simulation.robot, scene.motion
    rng = np.random.default_rng(0)
    lower, upper = np.maximum(robot.lower, -np.pi), np.minimum(robot.upper, np.pi)
    corners = rng.uniform(lower, upper, (4 * WIDE_ROWS // STOPS_EVERY, len(lower)))
    along = np.arange(4 * WIDE_ROWS - STOPS_EVERY) / STOPS_EVERY
    corner = np.arange(len(corners), dtype=np.float64)
    q = np.column_stack([np.interp(along, corner, column) for column in corners.T])
    seen = scene.simulation.positions(Motion(q, None, np.zeros(len(q), dtype=np.int64)))[:, 2] > IN_FRONT_M
    q = q[seen][:WIDE_ROWS] if seen.sum() > WIDE_ROWS // 2 else q[:WIDE_ROWS]
    clock = motion.clock
    t = np.sort(rng.uniform(clock[0], clock[-1], len(q)))
    spread = 1.0 / float(np.median(np.linalg.norm(scene.whitening, axis=(1, 2))))
    whitening = np.broadcast_to(np.eye(3) / spread, (len(q), 3, 3))
    return replace(scene, motion=Motion(q, t, np.zeros(len(q), dtype=np.int64)), whitening=whitening)


def solved(columns: FloatArray, target: FloatArray) -> FloatArray:
    """Solve least squares, with columns of any scale."""
    scales = np.linalg.norm(columns, axis=0)
    scales = np.where(scales > 0.0, scales, 1.0)
    return np.linalg.lstsq(columns / scales, target, rcond=1e-8)[0] / scales


def orthonormal(columns: FloatArray) -> FloatArray:
    """Return an orthonormal basis of the span of columns (m, p)."""
    if not columns.shape[1]:
        return columns
    scales = np.linalg.norm(columns, axis=0)
    left, values, _ = np.linalg.svd(columns / np.where(scales > 0.0, scales, 1.0), full_matrices=False)
    return left[:, values > 1e-8]


def stepped(effects: Sequence[Effect], step: FloatArray) -> tuple[Effect, ...]:
    """Return the effects with their amounts changed by one step (p,)."""
    moved, first = [], 0
    for effect in effects:
        amounts = effect.amounts
        moved.append(_with_amounts(effect, effect.values[amounts] + step[first : first + len(amounts)]))
        first += len(amounts)
    return tuple(moved)


def _with_amounts(effect: Effect, amounts: FloatArray) -> Effect:
    values = effect.values.copy()
    values[effect.amounts] = amounts
    return effect.with_values(values)


def _ticks(q: FloatArray) -> FloatArray:
    """Return the smallest step (d,) between readings."""
    gaps = [np.diff(np.unique(np.round(column, 12))) for column in q.T]
    return np.array([gap[gap > 1e-9].min() if (gap > 1e-9).any() else 0.0 for gap in gaps])
