"""Locally weighted projection regression, after Vijayakumar, D'Souza and Schaal 2005 (Neural Computation 17).

Each receptive field is a Gaussian of its own width around a centre, with a local model of a few univariate regressions
along directions found by partial least squares. Fields are added where none is active; widths follow the gradient of
the leave-one-out error. All fields of all outputs are updated at once, as arrays.
"""

from __future__ import annotations

import copy
import math
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
_FIRST_ROWS = 64
_NOWHERE = -1


@dataclass(frozen=True)
class Settings:
    """Settings that the paper leaves to the user.

    Attributes:
        first_metric: diagonal of a new field's distance metric D (inputs scaled to about -1 .. 1).
        generate: activation below which a new field is made (w_gen).
        learning_rate: α of the distance metric, relative to the size of the gradient's terms.
        penalty: weight γ of the metric's size.
        forgetting: initial λ of all sums; it approaches `last_forgetting` (annealed as in the paper).
        add_projection: error ratio φ below which another projection is added.
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
    """Learner with inputs (d,) and several outputs at once; every output has its own fields.

    A field's sums are one row of a table: a pair costs one gather and one scatter of the active fields. In between they
    are stored by column, so that values of the same quantity are contiguous over the fields.
    """

    def __init__(self, inputs: int, outputs: int, settings: Settings | None = None) -> None:
        self.settings = Settings() if settings is None else settings
        self.inputs, self.outputs = inputs, outputs
        self.projections = min(inputs, _MOST_PROJECTIONS)
        self.fields = 0
        self._layout = _layout(inputs, self.projections)
        sizes = {name: math.prod(shape) for name, shape in self._layout.items()}
        self._decayed_first = sum(sizes[name] for name in ("u", "moments", "weight", "mse"))
        self._decayed = self._decayed_first + sum(sizes[name] for name in ("h", "r2", "cv"))
        self._table = np.empty((_FIRST_ROWS, sum(sizes.values())))
        self._output, self._centre = np.empty(_FIRST_ROWS, dtype=np.intp), np.empty((_FIRST_ROWS, inputs))
        # Most fields never see enough pairs to change their metric: they all share the first one. For the others:
        # Cholesky roots of their metrics, and each field's index among these.
        self._moved, self._root = np.empty(0, dtype=np.intp), np.empty((0, inputs, inputs))
        self._place = np.empty(_FIRST_ROWS, dtype=np.intp)
        self._upper = np.triu(np.ones((inputs, inputs)))

    def learn(self, x: FloatArray, y: FloatArray) -> None:
        """Learn one pair: x (d,) and y (outputs,)."""
        activation = self._activations(x)
        closest = np.zeros(self.outputs)
        np.maximum.at(closest, self._output[: self.fields], activation)
        for output in np.flatnonzero(closest < self.settings.generate).tolist():
            self._add(x, float(y[output]), output)
            activation = np.append(activation, 1.0)
        active = np.flatnonzero(activation > _SLIGHT)
        self._update(active, activation[active], x, y[self._output[active]])

    def predict(self, x: FloatArray) -> FloatArray:
        """Predict outputs (n, outputs) at x (n, d): the fields' local predictions, weighted by activation."""
        out = np.zeros((len(x), self.outputs))
        for start in range(0, len(x), 256):
            part = slice(start, start + 256)
            out[part] = self._blended(x[part])
        return out

    def _blended(self, x: FloatArray) -> FloatArray:
        every, d = self._named(self._table[: self.fields].T), self.inputs
        activation = self._activations(x[:, None])
        local = every["mean"][d] + np.zeros_like(activation)
        z = x[:, None, :] - every["mean"][:d].T
        known = every["seen"] > self.settings.trusted_pairs * d
        for k in range(self.projections):
            u, moments = every["u"][k], every["moments"][k]
            sz, sr, ss = moments[:d], moments[d], np.maximum(moments[d + 1], _TINY)
            s = np.einsum("nkd,dk->nk", z, u / np.maximum(np.linalg.norm(u, axis=0), _TINY))
            local += np.where(known & (k < every["used"]), s * (sr / ss), 0.0)
            z -= s[..., None] * (sz / ss).T
        out = np.zeros((len(x), self.outputs))
        for output in range(self.outputs):
            own = self._output[: self.fields] == output
            if own.any():
                weights = activation[:, own] + np.finfo(np.float64).tiny
                out[:, output] = (weights * local[:, own]).sum(axis=1) / weights.sum(axis=1)
        return out

    def _activations(self, x: FloatArray) -> FloatArray:
        """Return activations (..., fields) at x (d,) or (n, 1, d)."""
        off = x - self._centre[: self.fields]
        distances = self.settings.first_metric * np.einsum("...i,...i->...", off, off)
        if len(self._moved):
            turned = self._root @ off[..., self._moved, :, None]
            distances[..., self._moved] = np.square(turned[..., 0]).sum(axis=-1)
        return np.exp(-0.5 * distances)

    def _add(self, x: FloatArray, y: float, output: int) -> None:
        if self.fields == len(self._table):
            self._table, self._output, self._centre, self._place = (
                np.concatenate([array, np.empty_like(array)])
                for array in (self._table, self._output, self._centre, self._place)
            )
        at = self.fields
        self.fields += 1
        self._table[at] = 0.0
        fresh = self._named(self._table[at])
        fresh["mean"][:-1], fresh["mean"][-1] = x, y
        fresh["used"][...], fresh["weight"][...] = min(2, self.projections), _TINY
        fresh["forgetting"][...] = self.settings.forgetting
        self._output[at], self._centre[at], self._place[at] = output, x, _NOWHERE

    def _named(self, columns: FloatArray) -> dict[str, FloatArray]:
        """Return views of the table's columns (numbers, ...) by name."""
        named: dict[str, FloatArray] = {}
        begin = 0
        for name, shape in self._layout.items():
            end = begin + math.prod(shape)
            named[name] = columns[begin:end].reshape(shape + columns.shape[1:])
            begin = end
        return named

    def _update(self, at: IntArray, w: FloatArray, x: FloatArray, y: FloatArray) -> None:
        """Update the recursive sums of the local models (table 3 of the paper), then the metric."""
        columns = self._table.take(at, axis=0).T.copy()
        field = self._named(columns)
        keep, settings = field["forgetting"].copy(), self.settings
        columns[: self._decayed_first] *= keep
        field["seen"] += 1.0
        field["weight"] += w
        # Inputs, output and, as soon as it exists, the projected input of each field.
        z = np.empty((self.inputs + 2, len(at)))
        z[:-2], z[-2] = x[:, None], y
        field["mean"] += w / field["weight"] * (z[:-1] - field["mean"])
        z[:-1] -= field["mean"]
        projected = self._project(field, w, z)
        step = self._weigh(field, columns, w, z[-2], projected, keep)
        if step is not None:
            ready, *sizes = step
            self._move(at[ready], x, *sizes)
        self._grow(field)
        field["forgetting"][...] = settings.annealing * keep + (1.0 - settings.annealing) * settings.last_forgetting
        self._table[at] = columns.T

    def _project(self, field: dict[str, FloatArray], w: FloatArray, z: FloatArray) -> FloatArray:
        """Apply partial least squares to inputs and output in z (d + 2, k), which becomes their remainder.

        Return the coefficients of the mean (a regression on a constant) and of each projection (r + 1, k).
        """
        used = field["used"]
        least, most = int(used.min()), int(used.max())
        projected, rests = np.zeros((self.projections + 1, len(w))), np.empty((self.projections + 1, len(w)))
        projected[0], rests[0] = 1.0, z[-2]
        for k in range(most):
            u, moments = field["u"][k], field["moments"][k]
            pull = w * z[-2]
            if k >= least:
                pull *= k < used
            u += pull * z[:-2]
            s = _dots(z[:-2], u) / np.maximum(np.sqrt(_dots(u, u)), _TINY)
            if k >= least:
                s *= k < used
            projected[k + 1] = z[-1] = s
            moments += (w * s) * z
            z[:-1] -= (s / np.maximum(moments[-1], _TINY)) * moments[:-1]
            rests[k + 1] = z[-2]
        rests[most + 1 :] = z[-2]
        field["mse"] += w * rests * rests
        return projected

    def _grow(self, field: dict[str, FloatArray]) -> None:
        """Add a projection to fields whose last one reduced the error, once they have enough pairs."""
        used, error = field["used"], field["mse"]
        able = np.flatnonzero((used < self.projections) & (field["seen"] > self.settings.trusted_pairs * self.inputs))
        if len(able):
            last = used[able].astype(np.intp)
            used[able] += error[last, able] < self.settings.add_projection * error[last - 1, able]

    def _weigh(
        self,
        field: dict[str, FloatArray],
        columns: FloatArray,
        w: FloatArray,
        error: FloatArray,
        s: FloatArray,
        keep: FloatArray,
    ) -> tuple[IntArray, FloatArray, FloatArray, FloatArray] | None:
        """Update the sums of J = Σ w e²/(1 − h)² / W + γ/d Σ D² with one pair.

        Return the fields that are ready to move, with their w dJ/dw, w / W and degree of settling, or None if no field
        is ready.
        """
        total = field["weight"]
        squares = np.concatenate([total[None], field["moments"][:, -1]])
        share = np.where(squares > _TINY, s / np.maximum(squares, _TINY), 0.0)
        leverage = _dots(s, share)
        room = 1.0 - np.minimum(np.maximum(w * leverage, 0.0), _MOST_LEVERAGE)
        weighted = w * error / room
        cost = weighted * error / room
        # In units of full activation, so that a few pairs at a field's fringe do not move it.
        ready = np.flatnonzero(total > self.settings.trusted_pairs * self.inputs)
        by_weight = None
        if len(ready):
            # The pair's own share and leverage, and the effect of the slopes on all earlier errors and leverages.
            before = error * _dots(share, field["h"]) + _dots(share * share, field["r2"])
            by_weight = cost * (1.0 + 2.0 * w * leverage / room) - w * (2.0 * before + field["cv"] / total)
        columns[self._decayed_first : self._decayed] *= keep
        field["cv"] += cost
        field["h"] += (weighted / room) * s
        field["r2"] += (cost * w / room) * (s * s)
        if by_weight is None:
            return None
        # A leave-one-out error far above the training error shows that the field has too few pairs to move.
        mse = field["mse"][field["used"][ready].astype(np.intp), ready]
        settled = np.minimum((mse / np.maximum(field["cv"][ready], _TINY)) ** 4, 1.0)
        return ready, by_weight[ready] / total[ready], w[ready] / total[ready], settled

    def _move(self, at: IntArray, x: FloatArray, by_weight: FloatArray, share: FloatArray, settled: FloatArray) -> None:
        """Step the Cholesky roots of these fields down the gradient, limited to the change allowed per pair."""
        place = self._places(at)
        root, off = self._root[place], x - self._centre[at]
        # dw/dM = -w M off offᵀ; d(Σ D²)/dM = 4 M D
        slope = (root @ (-by_weight[:, None] * off)[:, :, None]) * off[:, None, :]
        metric = root.swapaxes(1, 2) @ root
        slope += (4.0 * self.settings.penalty / self.inputs * share)[:, None, None] * (root @ metric)
        step = (self.settings.learning_rate * settled)[:, None, None] * slope * self._upper
        # A single pair never changes a root by more than a share of itself.
        size, limit = np.abs(step).max(axis=(1, 2)), _LARGEST_STEP * np.abs(root).max(axis=(1, 2))
        step *= np.minimum(1.0, limit / np.maximum(size, _TINY))[:, None, None]
        self._root[place] = root - np.where(np.isfinite(size)[:, None, None], step, 0.0)

    def _places(self, at: IntArray) -> IntArray:
        """Return the indices of these fields' roots; add a root for fields that have not moved before."""
        fresh = at[self._place[at] == _NOWHERE]
        if len(fresh):
            first = np.sqrt(self.settings.first_metric) * np.eye(self.inputs)
            self._place[fresh] = len(self._moved) + np.arange(len(fresh))
            self._moved = np.concatenate([self._moved, fresh])
            self._root = np.concatenate([self._root, np.broadcast_to(first, (len(fresh), *first.shape))])
        return self._place[at]


def _dots(first: FloatArray, second: FloatArray) -> FloatArray:
    """Return inner products (k,) of columns (m, k)."""
    return np.add.reduce(first * second, axis=0)


def _layout(inputs: int, projections: int) -> dict[str, tuple[int, ...]]:
    """Return the names and shapes in a field's row.

    The order is: sums that a pair decays first, sums that the metric needs undecayed, then the rest. `moments` are
    those of a projection with inputs, output and itself.
    """
    d, r = inputs, projections
    first = {"u": (r, d), "moments": (r, d + 2), "weight": (), "mse": (r + 1,)}
    return (
        first | {"h": (r + 1,), "r2": (r + 1,), "cv": ()} | {"mean": (d + 1,), "seen": (), "used": (), "forgetting": ()}
    )


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
    """Return the first metric with the lowest error on a held-out fifth of the pairs."""
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
