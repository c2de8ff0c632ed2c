"""Rigid chain fitted to marker orientations, in addition to positions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self, cast

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import solve_triangular  # pyright: ignore[reportMissingTypeStubs, reportUnknownVariableType]

from kbmaps.arrays import FloatArray, batches, evenly_spread, frozen, rows
from kbmaps.chains.belief import ChainBelief
from kbmaps.chains.chain import RigidChain
from kbmaps.chains.parameters import CHAIN, ChainParameters, chain_arrays, chain_from_arrays
from kbmaps.errors import DegenerateDataError, NonFiniteError, SettingError, ShapeError
from kbmaps.packed import complete, number, pack, restoring, unpack
from kbmaps.prequential import shared_by
from kbmaps.robust import MEDIAN_NORM
from kbmaps.rotations import exponentials, nearest_rotation, rotation_matrices, rotation_vectors

_KIND = "oriented chain, 1"


class _Settings:
    # Number of candidate rotations of the marker on the hand to start from.
    candidates = 64
    steps = 8
    # Degrees of freedom of Student's t: a residual of many sigmas counts little, one within them nearly as in least
    # squares.
    freedom = 6.0


# Lower bound of the noise of a measured orientation [rad]: below is rounding.
_ROUNDING_RAD = float(np.sqrt(np.finfo(np.float64).eps))


@dataclass(frozen=True, eq=False)
class OrientedChain:
    """Posterior of a chain, and of the rotation of the marker's own frame in the chain's marker frame.

    The marker is measured as R(q) · turn, with R(q) the rotation of the chain's last frame.

    Attributes:
        parameters: the parametrisation, with the reference chain.
        mean: their values (size,) [rad, m].
        turn: rotation (3, 3) of the marker in the chain's last frame; constant, and unknown before the fit.
        root: matrix W (size + 3, k), the covariance W Wᵀ of the parameters and of a small rotation τ of the marker,
            exp([τ]×) · turn [rad].
        noise: 1-sigma of a measured orientation about one axis [rad].

    Raises:
        SettingError: a noise below 0.
    """

    parameters: ChainParameters
    mean: FloatArray
    turn: FloatArray
    root: FloatArray
    noise: float = 0.0

    def __post_init__(self) -> None:
        size = self.parameters.size
        shapes = {"mean": (size,), "turn": (3, 3), "root": (size + 3, *self.root.shape[1:2])}
        for name, shape in shapes.items():
            value = getattr(self, name)
            if value.shape != shape:
                raise ShapeError(name, str(shape), value.shape)
            if not np.isfinite(value).all():
                raise NonFiniteError(name)
            object.__setattr__(self, name, frozen(value))
        if not 0.0 <= self.noise < np.inf:
            raise SettingError(f"noise must be finite and not negative, got {self.noise!r}")

    @property
    def chain(self) -> RigidChain:
        """Most probable chain, its last frame rotated like the marker."""
        chain = self.parameters.chain(self.mean)
        fixed = chain.fixed.copy()
        fixed[-1, :3, :3] = nearest_rotation(fixed[-1, :3, :3] @ self.turn)
        return RigidChain(fixed, chain.axes, chain.prismatic)

    def orientation(self, q: ArrayLike) -> FloatArray:
        """Return rotations of the marker (n, 3, 3) at q (n, d)."""
        return self.orientation_with_variance(q)[0]

    def orientation_with_variance(self, q: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Return rotations (n, 3, 3) at q (n, d) and their first-order variance (n, 3) [rad²].

        The variance is that of a small rotation about each axis of the measurement frame.
        """
        angles = rows("q", q, self.parameters.reference.joints)
        rotations, variance = np.empty((len(angles), 3, 3)), np.empty((len(angles), 3))
        for part in batches(len(angles)):
            hand, omega = self.parameters.turned(self.mean, angles[part])
            rotations[part] = hand @ self.turn
            full = np.concatenate([omega, hand], axis=2)
            variance[part] = np.square(full @ self.root).sum(axis=2)
        return rotations, variance

    def to_bytes(self) -> bytes:
        """Return the chain and its posterior as one self-describing byte string."""
        arrays = {"mean": self.mean, "turn": self.turn, "root": self.root}
        return pack(_KIND, {"noise": self.noise}, chain_arrays(self.parameters.reference) | arrays)

    @classmethod
    def from_bytes(cls, data: bytes) -> Self:
        """Restore the bytes of `to_bytes`."""
        fields, arrays = unpack(data, _KIND)
        with restoring("an oriented chain"):
            complete(arrays, (*CHAIN, "mean", "turn", "root"))
            parameters = ChainParameters(chain_from_arrays(arrays))
            noise = number(fields["noise"], "the noise")
            return cls(parameters, arrays["mean"], arrays["turn"], arrays["root"], noise)


def fitted_orientation(belief: ChainBelief, q: ArrayLike, rotation: ArrayLike) -> OrientedChain:
    """Fit the most probable chain and rotation of the marker to measured orientations, robustly.

    Maximum a posteriori by Gauss-Newton steps on the rotation vectors of R_measured · (R(q) turn)ᵀ. Each is weighted
    as under Student's t (Lange, Little, Taylor 1989), with the noise from their median length. Along a path,
    neighbours share their errors; the weights are divided by the number that do (`shared_by`).

    Args:
        belief: posterior of the chain from positions. Parameters that it holds stay held.
        q: joint values (n, d) [rad, m], in the order of measurement.
        rotation: orientations, (n, 3, 3) or quaternions x, y, z, w (n, 4).

    Raises:
        DegenerateDataError: no orientations.

    Example:
        >>> import numpy as np
        >>> from kbmaps import ChainBelief, ChainParameters, ChainTolerances, RigidChain, fitted_orientation
        >>> fixed = np.tile(np.eye(4), (3, 1, 1))
        >>> arm = RigidChain(fixed, axes=[[0, 0, 1], [0, 1, 0]], prismatic=[False, False])
        >>> belief = ChainBelief.from_tolerances(ChainParameters(arm), ChainTolerances())
        >>> turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
        >>> q = np.array([[0.1, 0.2], [0.3, 0.4]])
        >>> fitted_orientation(belief, q, arm.orientation(q) @ turn).turn.round(6) + 0.0
        array([[ 0., -1.,  0.],
               [ 1.,  0.,  0.],
               [ 0.,  0.,  1.]])
    """
    angles = rows("q", q, belief.parameters.reference.joints)
    measured = rotation_matrices("rotation", rotation)
    if measured.shape != (len(angles), 3, 3):
        raise ShapeError("rotation", f"({len(angles)}, 3, 3) or ({len(angles)}, 4) to go with q", measured.shape)
    if not len(angles):
        raise DegenerateDataError("there are no orientations to fit")
    fit = _Fit(belief, angles, measured)
    for _ in range(_Settings.steps):
        fit.step()
    return fit.result()


class _Fit:
    """Gauss-Newton over the columns of the belief's root and the rotation of the marker."""

    def __init__(self, belief: ChainBelief, q: FloatArray, measured: FloatArray) -> None:
        self._belief, self._q, self._measured = belief, q, measured
        self._chosen = np.zeros(belief.root.shape[1])  # in units of the root's columns: a priori N(0, 1)
        self._mean = belief.mean
        hand, _ = belief.parameters.turned(self._mean, q)
        self._turn = _likely_turn(hand, measured)
        self._freedom = 3.0  # degrees of freedom that the parameters have used up so far

    def step(self) -> None:
        errors, columns = self._linearised()
        lengths = np.linalg.norm(errors, axis=1)
        noise = self._noise(lengths)
        weights = (_Settings.freedom + 3.0) / (_Settings.freedom + np.square(lengths / noise))
        shared = shared_by(errors[lengths <= 3.0 * MEDIAN_NORM * noise])
        scale = np.sqrt(weights / shared)[:, None] / noise
        free = len(self._chosen)
        # Square root of the normal equations, prior rows first: poorly and well known directions differ by more orders
        # of magnitude than their squares leave digits.
        stacked = np.zeros((free + errors.size, free + 4))
        stacked[:free, :free], stacked[:free, -1] = np.eye(free), -self._chosen
        stacked[free:, :-1] = (columns * scale[..., None]).reshape(errors.size, -1)
        stacked[free:, -1] = (errors * scale).ravel()
        triangle = cast(FloatArray, np.linalg.qr(stacked, mode="r"))
        self._root = np.asarray(solve_triangular(triangle[: free + 3, :-1], np.eye(free + 3)), dtype=np.float64)
        change = self._root @ triangle[: free + 3, -1]
        self._freedom = 3.0 + free - float(np.square(self._root[:free]).sum())
        self._chosen = self._chosen + change[:free]
        self._mean = self._belief.mean + self._belief.root @ self._chosen
        self._turn = exponentials(change[None, free:])[0][0] @ self._turn

    def result(self) -> OrientedChain:
        size = self._belief.parameters.size
        outward = np.zeros((size + 3, len(self._chosen) + 3))
        outward[:size, : len(self._chosen)] = self._belief.root
        outward[size:, len(self._chosen) :] = np.eye(3)
        noise = self._noise(np.linalg.norm(self._linearised()[0], axis=1))
        turn = nearest_rotation(self._turn)
        return OrientedChain(self._belief.parameters, self._mean, turn, outward @ self._root, noise)

    def _linearised(self) -> tuple[FloatArray, FloatArray]:
        """Return the errors (n, 3) [rad] and their derivatives by the unknowns (n, 3, k + 3)."""
        hand, omega = self._belief.parameters.turned(self._mean, self._q)
        errors = rotation_vectors(self._measured @ (hand @ self._turn).swapaxes(1, 2))
        return errors, np.concatenate([omega @ self._belief.root, hand], axis=2)

    def _noise(self, lengths: FloatArray) -> float:
        left = max(3.0 * len(lengths) - self._freedom, 1.0)
        return max(float(np.median(lengths)) / MEDIAN_NORM * float(np.sqrt(3.0 * len(lengths) / left)), _ROUNDING_RAD)


def _likely_turn(hand: FloatArray, measured: FloatArray) -> FloatArray:
    """Return the rotation, among those of single orientations, with the smallest median distance to the others."""
    turns = hand.swapaxes(1, 2) @ measured
    tried = turns[evenly_spread(len(turns), _Settings.candidates)]
    # tr(AᵀB) = 1 + 2 cos of the angle between them.
    traces = np.einsum("aij,bij->ab", tried, turns)
    return tried[int(np.median(traces, axis=1).argmax())]
