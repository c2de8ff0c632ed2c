"""How real arms differ from rigid chains, as small groups of features with a shape but no size yet."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from kbmaps.arrays import BoolArray, FloatArray
from kbmaps.basis import learning_bases
from kbmaps.block_choice import PATH_CORRELATION
from kbmaps.chain import RigidChain
from kbmaps.chain_parameters import ChainParameters
from kbmaps.stack import BasisStack

# Errors of a joint's angle [rad], as functions of its own reading or of gravity's torque about it.
ANGLE_GROUPS = ("eccentricity", "second harmonic", "gain", "compliance")
# Errors of a position [m], as polynomials of the position (the camera's) or functions of the readings.
CAMERA_GROUPS = ("affine", "quadratic", "cubic")
SMOOTH_GROUPS = ("one joint", "two joints", "three joints")
GROUPS = (*ANGLE_GROUPS, *CAMERA_GROUPS, *SMOOTH_GROUPS)
# Groups with more features than this are left out: arms of many joints then do with the lower orders.
MOST_FEATURES = 500
# With more joints, loads are lumped into two points: the marker and the middle of all joints beyond.
_JOINTS_WITH_OWN_LOADS = 8
# Ranges of a joint narrower than this [rad, m] would blow its functions up.
_LEAST_RANGE = 1e-3

Weights = Mapping[str, FloatArray]


@dataclass(frozen=True, eq=False)
class Linearised:
    """A distorted chain around a change and weights, at n configurations.

    Attributes:
        x: positions (n, 3) [m].
        chain: derivative (n, 3, size) by the chain's parameters.
        groups: derivative (n, 3, features) by each group's weights.
    """

    x: FloatArray
    chain: FloatArray
    groups: dict[str, FloatArray]


class ResidualFeatures:
    """A rigid chain with errors of its joints, of what measures it, and of what nobody has thought of.

        x(q) = p + Σ_g ψ_g w_g,     p = f(c, q + Σ_g φ_g(q) w_g)

    with the chain f at the change c, the angle groups' φ, and ψ of p (camera groups) or of q (smooth groups).

    Args:
        parameters: of the chain.
        q, x: the pairs (n, d) [rad, m] and (n, 3) [m], at least one: their ranges and spread scale the features.
    """

    def __init__(self, parameters: ChainParameters, q: FloatArray, x: FloatArray) -> None:
        self._parameters = parameters
        self._prismatic: BoolArray = parameters.reference.prismatic
        self.joints = parameters.reference.joints
        low, high = q.min(axis=0), q.max(axis=0)
        self._middle = 0.5 * (low + high)
        self._half = np.maximum(0.5 * (high - low), _LEAST_RANGE)
        self._centre = x.mean(axis=0)
        self._scale = max(math.sqrt(float(np.square(x - self._centre).mean())), _LEAST_RANGE)
        low, high = self._middle - self._half, self._middle + self._half
        self._stack = BasisStack(learning_bases(low, high, self._prismatic.tolist(), 1.0))
        self._products = {name: _products(self._prismatic, order + 1) for order, name in enumerate(SMOOTH_GROUPS)}
        self._loads = self._load_mask()

    def size(self, group: str) -> int:
        """Number of features of a group."""
        revolute = int((~self._prismatic).sum())
        if group in ("eccentricity", "second harmonic"):
            return 2 * revolute
        if group == "gain":
            return self.joints
        if group == "compliance":
            return int(self._loads.sum())
        if group in CAMERA_GROUPS:
            return 3 * (4, 6, 10)[CAMERA_GROUPS.index(group)]
        return 3 * len(self._products[group])

    def groups(self) -> tuple[str, ...]:
        """The groups that there are for this arm."""
        return tuple(group for group in GROUPS if 0 < self.size(group) <= MOST_FEATURES)

    def follow_a_path(self, q: FloatArray) -> bool:
        """Whether configurations (n, d), in their order, are neighbours on a path: as `kbmaps.follow_a_path`."""
        weights = self._stack.joint_weights(q)
        inner, square = np.einsum("nkm,nkm->nk", weights[:-1], weights[1:]), np.square(weights).sum(axis=2)
        shared = (inner / np.sqrt(square[:-1] * square[1:])).prod(axis=1)
        return bool(len(shared)) and bool(np.median(shared) > PATH_CORRELATION)

    def positions(self, change: FloatArray, chain: RigidChain, weights: Weights, q: FloatArray) -> FloatArray:
        """Positions (n, 3) [m] at q (n, d); `chain` is the parameters' chain at the change."""
        p = self._parameters.positions(change, self._angles(chain, weights, q))
        return p + self._offsets(p, q, weights)

    def linearised(
        self, change: FloatArray, chain: RigidChain, weights: Weights, q: FloatArray, groups: Sequence[str]
    ) -> Linearised:
        """Positions at q (n, d) and their derivatives by the change and by the weights of `groups`.

        That the camera magnifies moves of p by a little is left out of the derivatives.
        """
        frames = chain.frames(q) if "compliance" in groups or "compliance" in weights else None
        shapes = {g: self._angle_functions(g, q, frames) for g in ANGLE_GROUPS if g in groups or g in weights}
        p, jacobian = self._parameters.linearised(change, q + self._error(shapes, weights, q))
        turns = jacobian[:, :, self._parameters.zeros]
        columns = {g: self._columns(g, shapes[g], turns) for g in ANGLE_GROUPS if g in groups}
        for group in groups:
            if group not in ANGLE_GROUPS:
                columns[group] = _for_each_axis(self._offset_functions(group, p, q))
        return Linearised(p + self._offsets(p, q, weights), jacobian, {g: columns[g] for g in groups})

    def _angles(self, chain: RigidChain, weights: Weights, q: FloatArray) -> FloatArray:
        active = [group for group in ANGLE_GROUPS if group in weights]
        frames = chain.frames(q) if "compliance" in active else None
        return q + self._error({g: self._angle_functions(g, q, frames) for g in active}, weights, q)

    def _error(self, shapes: Weights, weights: Weights, q: FloatArray) -> FloatArray:
        """What is added to the readings (n, d) [rad, m]."""
        error = np.zeros_like(q)
        for group in shapes:
            if group in weights:
                mask = self._mask(group)
                spread = np.zeros(mask.shape)
                spread[mask] = weights[group]
                error += np.einsum("njm,jm->nj", shapes[group], spread)
        return error

    def _offsets(self, p: FloatArray, q: FloatArray, weights: Weights) -> FloatArray:
        total = np.zeros_like(p)
        for group, values in weights.items():
            if group not in ANGLE_GROUPS:
                total += self._offset_functions(group, p, q) @ values.reshape(-1, 3)
        return total

    def _columns(self, group: str, shapes: FloatArray, turns: FloatArray) -> FloatArray:
        """Derivatives (n, 3, features) by a group's weights, from its φ (n, d, m) and the joints' Jacobian (n, 3, d)."""
        return (turns[:, :, :, None] * shapes[:, None])[:, :, self._mask(group)]

    def _mask(self, group: str) -> BoolArray:
        """Which of a group's functions (d, m) there are."""
        if group == "compliance":
            return self._loads
        if group == "gain":
            return np.ones((self.joints, 1), dtype=np.bool_)
        return np.repeat(~self._prismatic[:, None], 2, axis=1)

    def _angle_functions(self, group: str, q: FloatArray, frames: FloatArray | None) -> FloatArray:
        """φ (n, d, m) of a group; of the order of 1 for revolute joints, of the positions' spread [m] for others."""
        if frames is not None and group == "compliance":
            return self._torques(frames)
        if group == "gain":
            return ((q - self._middle) / self._half * np.where(self._prismatic, self._scale, 1.0))[..., None]
        turns = q if group == "eccentricity" else 2.0 * q
        return np.stack([np.cos(turns), np.sin(turns)], axis=-1)

    def _torques(self, frames: FloatArray) -> FloatArray:
        """Torque (force, for a prismatic joint) about each joint of unit weights along x, y, z at each load's place.

        z·((p − o) × e_b) = e_b·(z × (p − o)): a weight's torque is its component of the Jacobian of its place p.
        Positions' spread counts as the unit of length. (n, d, 3 loads)
        """
        axes = np.einsum("nkij,kj->nki", frames[:, :-1, :3, :3], self._parameters.reference.axes)
        origins, places = frames[:, :-1, :3, 3], self._places(frames[:, :, :3, 3])
        torques = np.cross(axes[:, :, None], places - origins[:, :, None]) / self._scale
        torques = np.where(self._prismatic[:, None, None], self._scale * axes[:, :, None], torques)
        return torques.reshape(*torques.shape[:2], -1)

    def _places(self, points: FloatArray) -> FloatArray:
        """Where loads are supposed for each joint (n, d or 1, loads, 3), of the frames' origins (n, d+1, 3)."""
        if self.joints <= _JOINTS_WITH_OWN_LOADS:
            return points[:, None, 1:]
        beyond = np.cumsum(points[:, :0:-1], axis=1)[:, ::-1] / np.arange(self.joints, 0, -1)[:, None]
        return np.stack([beyond, np.broadcast_to(points[:, -1:], beyond.shape)], axis=2)

    def _load_mask(self) -> BoolArray:
        """Which loads (d, 3 loads) act on which joint: those beyond it."""
        if self.joints <= _JOINTS_WITH_OWN_LOADS:
            acts = np.triu(np.ones((self.joints, self.joints), dtype=np.bool_))
        else:
            acts = np.ones((self.joints, 2), dtype=np.bool_)
        return np.repeat(acts, 3, axis=1)

    def _offset_functions(self, group: str, p: FloatArray, q: FloatArray) -> FloatArray:
        """ψ (n, m) of a camera or a smooth group."""
        if group in SMOOTH_GROUPS:
            weights = self._stack.joint_weights(q)[:, :, 1:].reshape(len(q), -1)
            return weights[:, self._products[group]].prod(axis=2)
        s = (p - self._centre) / self._scale
        degree = CAMERA_GROUPS.index(group) + 1
        monomials = [s[:, list(c)].prod(axis=1) for c in itertools.combinations_with_replacement(range(3), degree)]
        return np.stack([np.ones(len(s)), *monomials] if degree == 1 else monomials, axis=1)


def _for_each_axis(functions: FloatArray) -> FloatArray:
    """Derivatives (n, 3, 3 m) of Σ_m ψ_m w_m by the weights w (m, 3), flattened, from ψ (n, m)."""
    n, m = functions.shape
    return (functions[:, None, :, None] * np.eye(3)[:, None]).reshape(n, 3, 3 * m)


def _products(prismatic: BoolArray, order: int) -> FloatArray:
    """Which joint functions (two a joint) multiply to each product of `order` different joints (count, order)."""
    sizes = [1 if slides else 2 for slides in prismatic]
    chosen = [
        [2 * joint + part for joint, part in zip(joints, parts, strict=True)]
        for joints in itertools.combinations(range(len(sizes)), order)
        for parts in itertools.product(*(range(sizes[joint]) for joint in joints))
    ]
    return np.array(chosen, dtype=np.intp).reshape(-1, order)
