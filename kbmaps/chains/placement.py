"""Pose and joint offsets of a chain, fitted to several readings of the same pairs side by side."""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import numpy as np

from kbmaps.arrays import BoolArray, FloatArray, IntArray
from kbmaps.chains.chain import RigidChain
from kbmaps.chains.parameters import ChainParameters
from kbmaps.robust import MEDIAN_NORM, RobustSettings
from kbmaps.rotations import cross_matrix, exponentials, rotation_vectors


class _Settings:
    steps: int = 30
    # Weights start nearly as in least squares; their scale halves with each step down to this many sigma.
    first_reach: float = 32.0
    min_reach: float = 4.0
    first_damping: float = 1e-3
    min_damping: float = 1e-9
    max_damping: float = 1e6
    # Once the weights have settled, a step that lowers the cost by less than this share is the last.
    small_gain: float = 1e-3
    settling: int = 4
    ridge: float = 1e-9  # holds undetermined directions; as a share of the largest diagonal entry


@dataclass(frozen=True, eq=False)
class Placements:
    """Nominal chain placed to s readings of the same n pairs."""

    # rotations, shifts: the pose of the nominal measurement frame in the real one (s, 3, 3) and (s, 3) [m]
    rotations: FloatArray
    shifts: FloatArray
    zeros: FloatArray  # joint offsets, added to the joints' readings (s, d) [rad, m]
    tools: FloatArray  # offsets of the marker in the marker frame (s, 3) [m]
    distances: FloatArray  # of the pairs from the chain (s, n) [m]

    def errors(self, share: float) -> FloatArray:
        """Return the RMS distance (s,) [m] of this share of the pairs, the nearest ones."""
        nearest = np.sort(np.square(self.distances), axis=1)[:, : int(np.ceil(share * self.distances.shape[1]))]
        return np.sqrt(nearest.mean(axis=1))


@dataclass(eq=False)
class _State:
    """Estimates (s, ...), with residuals (s, 3n) and their Jacobians (s, 3n, 9 + d)."""

    rotations: FloatArray
    shifts: FloatArray
    zeros: FloatArray
    tools: FloatArray
    residuals: FloatArray
    jacobian: FloatArray

    def put(self, rows: IntArray, other: _State, chosen: BoolArray) -> None:
        for name in self.__dataclass_fields__:
            getattr(self, name)[rows] = getattr(other, name)[chosen]

    @property
    def distances(self) -> FloatArray:
        return np.linalg.norm(self.residuals.reshape(len(self.residuals), -1, 3), axis=2)


def place(
    chain: RigidChain,
    q: FloatArray,
    x: FloatArray,
    *,
    zeros_std: FloatArray,
    tool_std: float,
    tools: FloatArray | None = None,
) -> Placements:
    """Fit the pose of the measurement frame, the marker and the joint offsets to each reading; links stay nominal.

    Levenberg-Marquardt from the best placement of the nominal chain (Kabsch 1976), with Geman-McClure weights. Inputs
    are not checked.

    Args:
        chain: the nominal chain.
        q: joint angles (s, n, d) [rad, m].
        x: marker positions (s, n, 3) [m].
        zeros_std: 1-sigma of each joint offset (d,) [rad, m].
        tool_std: 1-sigma of each coordinate of the marker about its nominal position [m].
        tools: marker offsets (s, 3) [m] to start from; none by default.
    """
    return _Fitter(chain, q, x, np.concatenate([np.zeros(6), zeros_std**-2.0, np.full(3, tool_std**-2.0)])).run(tools)


class _Fitter:
    """Minimiser of the weighted sum of squares over sigma² plus the prior's term for joint offsets and marker."""

    def __init__(self, chain: RigidChain, q: FloatArray, x: FloatArray, information: FloatArray) -> None:
        self._q, self._x, self._information = np.ascontiguousarray(q), x, information
        self._parameters = p = ChainParameters(chain)
        self._columns = np.r_[p.base_turn, p.base_shift, p.zeros, p.tool]
        self._linearise = p.lineariser(self._columns)
        # The rank lies above the median by the number of pairs that the parameters can always explain.
        self._middle = min(q.shape[1] // 2 + len(information) // 6, q.shape[1] - 1)

    def run(self, tools: FloatArray | None) -> Placements:
        count = len(self._q)
        every = np.arange(count)
        state = self._start(every, np.zeros((count, 3)) if tools is None else tools)
        damping, active = np.full(count, _Settings.first_damping), every
        for k in range(_Settings.steps):
            reach = max(_Settings.first_reach * 0.5**k, _Settings.min_reach)
            distances = state.distances[active]
            sigma = np.partition(distances, self._middle)[:, self._middle] / MEDIAN_NORM
            sigma = np.maximum(sigma, RobustSettings.rounding_m)
            scale = np.square(reach * sigma)[:, None]
            weights = np.repeat(np.square(scale / (scale + np.square(distances))), 3, axis=1) / sigma[:, None] ** 2
            tried = self._moved(state, active, self._step(state, active, weights, damping[active]))
            before, after = self._cost(state, active, weights), self._cost(tried, slice(None), weights)
            better = after <= before
            state.put(active[better], tried, better)
            damping[active] = np.where(
                better, np.maximum(0.1 * damping[active], _Settings.min_damping), 10.0 * damping[active]
            )
            settled = better & (k >= _Settings.settling) & (before - after < _Settings.small_gain * before)
            active = active[~(settled | (damping[active] > _Settings.max_damping))]
            if not len(active):
                break
        return Placements(state.rotations, state.shifts, state.zeros, state.tools, state.distances)

    def _start(self, every: IntArray, tools: FloatArray) -> _State:
        count, _, d = self._q.shape
        changes = np.zeros((count, self._parameters.size))
        changes[:, self._parameters.tool] = tools
        drawn = np.stack([self._parameters.positions(*reading) for reading in zip(changes, self._q, strict=True)])
        centred = drawn - drawn.mean(axis=1, keepdims=True)
        covariance = centred.swapaxes(1, 2) @ (self._x - self._x.mean(axis=1, keepdims=True))
        u, _, vt = np.linalg.svd(covariance)
        handed = np.ones((count, 1, 3))
        handed[:, 0, 2] = np.sign(np.linalg.det(u @ vt))
        rotations = ((u * handed) @ vt).swapaxes(1, 2)
        shifts = self._x.mean(axis=1) - (rotations @ drawn.mean(axis=1)[..., None])[..., 0]
        return self._at(every, rotations, shifts, np.zeros((count, d)), tools.copy())

    def _moved(self, state: _State, rows: IntArray, step: FloatArray) -> _State:
        turns = exponentials(step[:, :3])[0]
        return self._at(
            rows,
            turns @ state.rotations[rows],
            state.shifts[rows] + step[:, 3:6],
            state.zeros[rows] + step[:, 6:-3],
            state.tools[rows] + step[:, -3:],
        )

    def _at(
        self, rows: IntArray, rotations: FloatArray, shifts: FloatArray, zeros: FloatArray, tools: FloatArray
    ) -> _State:
        count, n, _ = self._q[rows].shape
        changes = np.zeros((count, self._parameters.size))
        changes[:, self._columns] = np.concatenate([rotation_vectors(rotations), shifts, zeros, tools], axis=1)
        markers, jacobian = np.empty((count, n, 3)), np.empty((count, n, 3, len(self._columns)))
        for k, row in enumerate(rows):
            self._linearise(changes[k], self._q[row], markers[k], jacobian[k])
        # A step rotates the present frame, and is not added to its rotation vector.
        jacobian[..., :3] = cross_matrix(shifts[:, None] - markers)
        residuals = (self._x[rows] - markers).reshape(count, 3 * n)
        return _State(rotations, shifts, zeros, tools, residuals, jacobian.reshape(count, 3 * n, -1))

    def _step(self, state: _State, rows: IntArray, weights: FloatArray, damping: FloatArray) -> FloatArray:
        weighted = state.jacobian[rows] * weights[..., None]
        gram = weighted.swapaxes(1, 2) @ state.jacobian[rows]
        slope = (weighted.swapaxes(1, 2) @ state.residuals[rows][..., None])[..., 0]
        slope[:, 6:] -= self._information[6:] * np.concatenate([state.zeros[rows], state.tools[rows]], axis=1)
        diagonal = np.einsum("sff->sf", gram)
        diagonal += self._information
        diagonal += damping[:, None] * diagonal + _Settings.ridge * diagonal.max(axis=1, keepdims=True)
        return cast(FloatArray, np.linalg.solve(gram, slope[..., None])[..., 0])

    def _cost(self, state: _State, rows: IntArray | slice, weights: FloatArray) -> FloatArray:
        prior = np.square(state.zeros[rows]) @ self._information[6:-3]
        prior += np.square(state.tools[rows]) @ self._information[-3:]
        return prior + (weights * np.square(state.residuals[rows])).sum(axis=1)
