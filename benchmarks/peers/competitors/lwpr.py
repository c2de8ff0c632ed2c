"""Locally weighted projection regression, after Vijayakumar, D'Souza and Schaal 2005 (Neural Computation 17).

Each receptive field is a Gaussian of its own width around a centre, with a local model of a few univariate regressions
along directions found by partial least squares. Fields are added where none is active; widths follow the gradient of
the leave-one-out error. All fields of all outputs are updated at once, as arrays.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass

import numpy as np

from benchmarks.peers.problem import Competitor, Fitted, Offset, Problem
from kbmaps.arrays import FloatArray, IntArray

_SLIGHT = 1e-3
_TINY = 1e-10
_MOST_LEVERAGE = 0.9
_LARGEST_STEP = 0.1
# The paper: a few projections do, whatever the number of inputs.
_MOST_PROJECTIONS = 4


@dataclass(frozen=True)
class Settings:
    """What the paper leaves to the user.

    Attributes:
        first_metric: diagonal of a new field's distance metric D (inputs scaled to about -1 .. 1).
        generate: activation below which a new field is made (w_gen).
        learning_rate: of the distance metric (α), relative to the size of the gradient's terms.
        penalty: weight γ of the metric's size.
        forgetting: λ of all sums at first; it goes to `last_forgetting` (annealed as in the paper).
        add_projection: error ratio φ below which another projection is worth while.
    """

    first_metric: float = 10.0
    generate: float = 0.1
    learning_rate: float = 30.0
    penalty: float = 1e-6
    forgetting: float = 0.995
    last_forgetting: float = 0.9999
    annealing: float = 0.9995
    add_projection: float = 0.9
    trusted_pairs: float = 2.0


class LWPR:
    """Inputs (d,), several outputs at once; every output has its own fields."""

    def __init__(self, inputs: int, outputs: int, settings: Settings | None = None) -> None:
        self.settings = Settings() if settings is None else settings
        self.inputs, self.outputs = inputs, outputs
        self.projections = min(inputs, _MOST_PROJECTIONS)
        d, r = inputs, self.projections
        self.output = np.empty(0, dtype=np.intp)
        self.centre, self.root = np.empty((0, d)), np.empty((0, d, d))
        self.mean_x, self.mean_y = np.empty((0, d)), np.empty(0)
        self.weight, self.seen, self.used = np.empty(0), np.empty(0), np.empty(0, dtype=np.intp)
        self.u, self.sz = np.empty((0, r, d)), np.empty((0, r, d))
        self.ss, self.sr, self.mse = np.empty((0, r)), np.empty((0, r)), np.empty((0, r + 1))
        self.h, self.r2 = np.empty((0, r + 1)), np.empty((0, r + 1))
        self.cv, self.forgetting = np.empty(0), np.empty(0)

    @property
    def fields(self) -> int:
        return len(self.output)

    def learn(self, x: FloatArray, y: FloatArray) -> None:
        """One pair: x (d,) and y (outputs,)."""
        activation = self._activations(x[None])[0]
        for output in range(self.outputs):
            own = activation[self.output == output]
            if own.size == 0 or own.max() < self.settings.generate:
                self._add(x, y[output], output)
                activation = np.append(activation, 1.0)
        active = np.flatnonzero(activation > _SLIGHT)
        self._update(active, activation[active], x, y[self.output[active]])

    def predict(self, x: FloatArray) -> FloatArray:
        """Outputs (n, outputs) at x (n, d): the fields' local predictions, weighted by activation."""
        out = np.zeros((len(x), self.outputs))
        for start in range(0, len(x), 256):
            part = slice(start, start + 256)
            out[part] = self._blended(x[part])
        return out

    def _blended(self, x: FloatArray) -> FloatArray:
        activation = self._activations(x)
        local = self.mean_y + np.zeros_like(activation)
        z = x[:, None, :] - self.mean_x
        for k in range(self.projections):
            in_use = (k < self.used) & (self.seen > self.settings.trusted_pairs * self.inputs)
            s, beta, p = self._projection(k, z)
            local += np.where(in_use, s * beta, 0.0)
            z = z - s[..., None] * p
        out = np.zeros((len(x), self.outputs))
        for output in range(self.outputs):
            own = self.output == output
            if own.any():
                weights = activation[:, own] + np.finfo(np.float64).tiny
                out[:, output] = (weights * local[:, own]).sum(axis=1) / weights.sum(axis=1)
        return out

    def _activations(self, x: FloatArray) -> FloatArray:
        off = np.einsum("kij,nkj->nki", self.root, x[:, None] - self.centre)
        return np.exp(-0.5 * np.einsum("nki,nki->nk", off, off))

    def _projection(self, k: int, z: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Projected input s, slope and direction to take out, of projection k."""
        u = self.u[:, k]
        u = u / np.maximum(np.linalg.norm(u, axis=-1, keepdims=True), _TINY)
        ss = np.maximum(self.ss[:, k], _TINY)
        return (z * u).sum(axis=-1), self.sr[:, k] / ss, self.sz[:, k] / ss[:, None]

    def _add(self, x: FloatArray, y: float, output: int) -> None:
        d, r = self.inputs, self.projections
        root = np.sqrt(self.settings.first_metric) * np.eye(d)
        fresh: dict[str, object] = {
            "output": output, "centre": x, "root": root, "mean_x": x, "mean_y": y, "weight": _TINY, "seen": 0.0,
            "used": min(2, r), "u": np.zeros((r, d)), "sz": np.zeros((r, d)), "ss": np.zeros(r), "sr": np.zeros(r),
            "mse": np.zeros(r + 1), "h": np.zeros(r + 1), "r2": np.zeros(r + 1), "cv": 0.0,
            "forgetting": self.settings.forgetting,
        }  # fmt: skip
        for name, value in fresh.items():
            old = getattr(self, name)
            setattr(self, name, np.concatenate([old, np.asarray(value, dtype=old.dtype)[None]]))

    def _update(self, at: IntArray, w: FloatArray, x: FloatArray, y: FloatArray) -> None:
        """Recursive sums of the local models (table 3 of the paper), then the metric."""
        keep = self.forgetting[at]
        self.seen[at] += 1.0
        weight = keep * self.weight[at] + w
        self.mean_x[at] += (w / weight)[:, None] * (x - self.mean_x[at])
        self.mean_y[at] += w / weight * (y - self.mean_y[at])
        self.weight[at] = weight
        z, rest = x - self.mean_x[at], y - self.mean_y[at]
        self.mse[at, 0] = keep * self.mse[at, 0] + w * rest**2
        projected = np.zeros((len(at), self.projections))
        residual = rest.copy()
        for k in range(self.projections):
            in_use = k < self.used[at]
            self.u[at, k] = keep[:, None] * self.u[at, k] + np.where(in_use, w * rest, 0.0)[:, None] * z
            u = self.u[at, k] / np.maximum(np.linalg.norm(self.u[at, k], axis=1, keepdims=True), _TINY)
            s = np.where(in_use, np.einsum("kd,kd->k", z, u), 0.0)
            self.ss[at, k] = keep * self.ss[at, k] + w * s * s
            self.sr[at, k] = keep * self.sr[at, k] + w * s * rest
            self.sz[at, k] = keep[:, None] * self.sz[at, k] + (w * s)[:, None] * z
            ss = np.maximum(self.ss[at, k], _TINY)
            projected[:, k] = s
            rest = rest - s * self.sr[at, k] / ss
            z = z - (s / ss)[:, None] * self.sz[at, k]
            self.mse[at, k + 1] = keep * self.mse[at, k + 1] + w * rest**2
            residual = np.where(in_use, rest, residual)
        self._move_metric(at, w, x, residual, projected, keep)
        self._grow(at)
        final = self.settings.last_forgetting
        self.forgetting[at] = self.settings.annealing * keep + (1.0 - self.settings.annealing) * final

    def _grow(self, at: IntArray) -> None:
        """Another projection where the last one paid, with enough pairs to tell."""
        rows = np.arange(len(at))
        last, before = self.mse[at][rows, self.used[at]], self.mse[at][rows, self.used[at] - 1]
        ready = self.seen[at] > self.settings.trusted_pairs * self.inputs
        more = ready & (last < self.settings.add_projection * before) & (self.used[at] < self.projections)
        self.used[at] += more

    def _move_metric(
        self, at: IntArray, w: FloatArray, x: FloatArray, error: FloatArray, s: FloatArray, keep: FloatArray
    ) -> None:
        """One step down the gradient of J = Σ w e²/(1 − h)² / W + γ/d Σ D², with respect to the Cholesky root of D."""
        # In units of full activation, so that a few pairs at a field's fringe do not move it.
        ready = self.weight[at] > self.settings.trusted_pairs * self.inputs
        # The mean counts as one more regression, on a constant.
        s = np.concatenate([np.ones((len(at), 1)), s], axis=1)
        total = self.weight[at]
        squares = np.concatenate([total[:, None], self.ss[at]], axis=1)
        share = np.where(squares > _TINY, s / np.maximum(squares, _TINY), 0.0)
        leverage = (s * share).sum(axis=1)
        h = np.clip(w * leverage, 0.0, _MOST_LEVERAGE)
        loo = error / (1.0 - h)
        # dJ/dw: the pair's own share and leverage, what the slopes do to all earlier errors and to their leverages.
        by_weight = (
            loo**2 * (1.0 + 2.0 * w * leverage / (1.0 - h))
            - 2.0 * error * (share * self.h[at]).sum(axis=1)
            - 2.0 * (share**2 * self.r2[at]).sum(axis=1)
            - self.cv[at] / total
        ) / total
        self.cv[at] = keep * self.cv[at] + w * loo**2
        self.h[at] = keep[:, None] * self.h[at] + (w * loo / (1.0 - h))[:, None] * s
        self.r2[at] = keep[:, None] * self.r2[at] + (w**2 * loo**2 / (1.0 - h))[:, None] * s**2
        root, off = self.root[at], x - self.centre[at]
        # dw/dM = -w M off offᵀ; d(Σ D²)/dM = 4 M D
        metric = np.swapaxes(root, 1, 2) @ root
        slope = -(by_weight * w)[:, None, None] * (root @ off[:, :, None]) * off[:, None, :]
        slope += (self.settings.penalty / self.inputs * w / total)[:, None, None] * 4.0 * (root @ metric)
        step = self.settings.learning_rate * np.triu(slope)
        # While its leave-one-out error is far above its training error a field knows too little to move.
        settled = (self.mse[at, self.used[at]] / np.maximum(self.cv[at], _TINY)) ** 4
        step *= np.minimum(settled, 1.0)[:, None, None]
        # A single pair never changes a root by more than a share of itself.
        size, limit = np.abs(step).max(axis=(1, 2)), _LARGEST_STEP * np.abs(root).max(axis=(1, 2))
        step *= np.minimum(1.0, limit / np.maximum(size, _TINY))[:, None, None]
        self.root[at] -= np.where((ready & np.isfinite(size))[:, None, None], step, 0.0)


# Updates of the final model (or one pass, if that is more), and of each one on trial.
_UPDATES, _TRIAL_UPDATES = 1500, 300
_METRICS = (0.3, 1.0, 4.0)
_LEAST_FOR_TRIAL = 10


@dataclass(frozen=True)
class _Arm:
    offset: Offset
    scale: float
    lwpr: LWPR
    problem: Problem

    def predict(self, q: FloatArray) -> FloatArray:
        return self.offset.predict(q) + self.scale * self.lwpr.predict(self.problem.scaled(q))


def learn(problem: Problem, earlier: Fitted | None) -> Fitted:
    offset = Offset.of(problem, earlier)
    rest = problem.x - offset.predict(problem.q)
    scale = max(float(rest.std()), 1e-9)
    q, y = problem.scaled(problem.q), rest / scale
    metric = _METRICS[0] if len(q) < _LEAST_FOR_TRIAL else _best_metric(q, y, problem)
    return _Arm(offset, scale, _trained(q, y, metric, max(_UPDATES, len(q)), problem), problem)


def _best_metric(q: FloatArray, y: FloatArray, problem: Problem) -> float:
    """The first width that serves best for a fifth of the pairs when learnt from the others."""
    held = len(q) // 5
    errors = []
    for metric in _METRICS:
        model = _trained(q[held:], y[held:], metric, _TRIAL_UPDATES, problem)
        errors.append(float(np.linalg.norm(model.predict(q[:held]) - y[:held], axis=1).mean()))
    return _METRICS[int(np.nanargmin(errors))]


def _trained(q: FloatArray, y: FloatArray, metric: float, updates: int, problem: Problem) -> LWPR:
    model = LWPR(q.shape[1], y.shape[1], Settings(first_metric=metric))
    rng = copy.deepcopy(problem.rng)
    order = np.concatenate([rng.permutation(len(q)) for _ in range(-(-updates // len(q)))])
    for index in order[:updates]:
        model.learn(q[index], y[index])
    return model


COMPETITOR = Competitor(
    "lwpr",
    "LWPR",
    "peer",
    learn,
    "Locally weighted projection regression, own implementation after Vijayakumar, D'Souza and Schaal 2005 "
    "(projections by incremental partial least squares, fields added where none is active, widths by the gradient of "
    "the leave-one-out error); first width chosen on a fifth held out, 1,500 updates (or one pass, if that is more) in "
    "passes over the pairs; learns the errors of the drawing, or of its own model before a tool change.",
)
