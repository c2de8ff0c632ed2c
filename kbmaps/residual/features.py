"""Deviations of real arms from rigid chains, as small groups of features of known shape and unknown size."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from kbmaps.arrays import BoolArray, FloatArray, IntArray, vector
from kbmaps.chains.chain import RigidChain
from kbmaps.chains.parameters import ChainParameters
from kbmaps.errors import SettingError
from kbmaps.maps.basis import learning_bases
from kbmaps.maps.stack import BasisStack

# Errors of a joint's angle [rad], as functions of its own reading or of gravity's torque about it.
READING_GROUPS = ("eccentricity", "second harmonic", "gain")
COMPLIANCE = "compliance"
# Errors of a position [m], as polynomials of the position (the camera's) or functions of the readings.
CAMERA_GROUPS = ("affine", "quadratic", "cubic")
SMOOTH_GROUPS = ("one joint", "two joints", "three joints")


class _Settings:
    max_features: int = 500  # Larger groups are left out: arms of many joints then use the lower orders only
    # With more joints, loads are lumped into two points: the marker and the middle of all joints beyond.
    joints_with_own_loads: int = 8
    min_range: float = 1e-3  # narrower joint ranges [rad, m] would scale the functions up too far
    path_correlation: float = 0.9  # neighbours on a path share this much of smooth functions over the pairs' reach
    # A camera may be mounted on a head with up to this many joints; the link behind them then has constant gravity.
    max_neck_joints: int = 3


Weights = Mapping[str, FloatArray]


@dataclass(frozen=True, eq=False)
class Linearised:
    """Distorted chain linearised around a change and weights, at n configurations."""

    x: FloatArray  # positions (n, 3) [m]
    chain: FloatArray  # derivative (n, 3, size) by the chain's parameters
    groups: dict[str, FloatArray]  # derivative (n, 3, features) by each group's weights


@dataclass(frozen=True, eq=False)
class ResidualScaling:
    """Scaling that makes features of the order of 1 at the data, and the position of the last load on the hand.

    Raises:
        SettingError: a range or the spread is not positive.
    """

    # middle, half: of the ranges of the joints' readings (d,) [rad, m]
    middle: FloatArray
    half: FloatArray
    centre: FloatArray  # of the positions (3,) [m]
    scale: float  # their spread [m]
    # place of the last load in the frame of the last link (3,) [m]; None: the marker itself
    load: FloatArray | None = None

    def __post_init__(self) -> None:
        vector("half", self.half, len(self.middle))
        vector("middle", self.middle, len(self.half))
        vector("centre", self.centre, 3)
        if self.load is not None:
            vector("load", self.load, 3)
        if not ((self.half > 0.0).all() and 0.0 < self.scale < math.inf):
            raise SettingError("the ranges and the spread of the positions must be finite and greater than 0")

    @classmethod
    def of(cls, q: FloatArray, x: FloatArray) -> ResidualScaling:
        """Return the scaling of pairs (n, d) [rad, m] and (n, 3) [m], at least one."""
        low, high = q.min(axis=0), q.max(axis=0)
        half = np.maximum(0.5 * (high - low), _Settings.min_range)
        centre = x.mean(axis=0)
        spread = math.sqrt(float(np.square(x - centre).mean()))
        return cls(0.5 * (low + high), half, centre, max(spread, _Settings.min_range))

    @classmethod
    def whole_turns(cls, joints: int) -> ResidualScaling:
        """Return the scaling to use without pairs."""
        return cls(np.zeros(joints), np.full(joints, math.pi), np.zeros(3), 1.0)


class ResidualFeatures:
    """Rigid chain with errors of its joints and its camera, and smooth errors without a named cause.

        x(q) = p + Σ_g ψ_g w_g,   p = f(c, q + Σ_g φ_g(q) w_g)

    with the chain f at the change c, the angle groups' φ, and ψ of p (camera groups) or of q (smooth groups).

    Args:
        parameters: parameters of the chain.
        scaling: scaling of the features.
    """

    def __init__(self, parameters: ChainParameters, scaling: ResidualScaling) -> None:
        self.parameters, self.scaling = parameters, scaling
        self._prismatic: BoolArray = parameters.reference.prismatic
        self.joints = parameters.reference.joints
        low, high = scaling.middle - scaling.half, scaling.middle + scaling.half
        self._stack = BasisStack(learning_bases(low, high, self._prismatic.tolist(), 1.0))
        self._products = {name: _products(self._prismatic, order + 1) for order, name in enumerate(SMOOTH_GROUPS)}
        still = range(min(_Settings.max_neck_joints, self.joints - 2) + 1)
        self._still = {f"{COMPLIANCE} behind joint {k}" if k else COMPLIANCE: k for k in still}
        self._loads = {group: self._load_mask(k) for group, k in self._still.items()}

    def size(self, group: str) -> int:
        """Return the number of features of a group."""
        if group in CAMERA_GROUPS:
            return 3 * (4, 6, 10)[CAMERA_GROUPS.index(group)]
        if group in SMOOTH_GROUPS:
            return 3 * len(self._products[group])
        return int(self._mask(group).sum())

    def groups(self) -> tuple[str, ...]:
        """Return the groups available for this arm."""
        names = (*READING_GROUPS, *self._still, *CAMERA_GROUPS, *SMOOTH_GROUPS)
        return tuple(group for group in names if 0 < self.size(group) <= _Settings.max_features)

    def approximate(self, groups: Iterable[str]) -> tuple[str, ...]:
        """Return the groups whose law is an engineering approximation instead of geometry."""
        return tuple(group for group in groups if group in self._still)

    def follow_a_path(self, q: FloatArray) -> bool:
        """Return True if consecutive configurations (n, d) are neighbours on a path.

        The criterion uses functions that are scaled to the configurations' reach.
        """
        weights = self._stack.joint_weights(q)
        inner, square = np.einsum("nkm,nkm->nk", weights[:-1], weights[1:]), np.square(weights).sum(axis=2)
        shared = (inner / np.sqrt(square[:-1] * square[1:])).prod(axis=1)
        return bool(len(shared)) and bool(np.median(shared) > _Settings.path_correlation)

    def positions(self, chain: RigidChain, weights: Weights, q: FloatArray) -> FloatArray:
        """Return positions (n, 3) [m] at q (n, d)."""
        error, _ = self._angle_errors(chain, weights, q, ())
        p = chain.positions(q + error)
        return p + self._offsets(p, q, weights)

    def linearised(
        self, change: FloatArray, chain: RigidChain, weights: Weights, q: FloatArray, groups: Sequence[str]
    ) -> Linearised:
        """Return positions at q (n, d) and their derivatives by the change, which gives `chain`, and by weights.

        Two second-order effects are left out of the derivatives, not of the positions: the camera magnifies changes of
        p slightly, and compliance changes the torque.
        """
        error, shapes = self._angle_errors(chain, weights, q, groups)
        p, jacobian = self.parameters.linearised(change, q + error)
        turns = jacobian[:, :, self.parameters.zeros]
        columns: dict[str, FloatArray] = {}
        for group in groups:
            if self._of_places(group):
                columns[group] = _for_each_axis(self._offset_functions(group, p, q))
            else:
                columns[group] = (turns[:, :, :, None] * shapes[group][:, None])[:, :, self._mask(group)]
        return Linearised(p + self._offsets(p, q, weights), jacobian, columns)

    def _angle_errors(
        self, chain: RigidChain, weights: Weights, q: FloatArray, groups: Sequence[str]
    ) -> tuple[FloatArray, dict[str, FloatArray]]:
        """Return offsets of the readings (n, d) [rad, m], and φ (n, d, m) of the angle groups weighted or requested.

        Torques are evaluated after the joints have deflected under the torques at the readings.
        """
        names = [g for g in (*READING_GROUPS, *self._still) if g in weights or g in groups]
        shapes = {group: self._reading_functions(group, q) for group in names if group in READING_GROUPS}
        error = self._weighted(shapes, weights, q)
        loaded = [group for group in names if group in self._still]
        if not loaded:
            return error, shapes
        yielding = [group for group in loaded if group in weights]
        there = q + error
        if yielding:
            frames, places = self._loaded_frames(chain, there)
            there = there + self._weighted({g: self._torques(g, frames, places) for g in yielding}, weights, q)
        frames, places = self._loaded_frames(chain, there)
        torques = {group: self._torques(group, frames, places) for group in loaded}
        return error + self._weighted(torques, weights, q), {**shapes, **torques}

    def _weighted(self, shapes: Weights, weights: Weights, q: FloatArray) -> FloatArray:
        """Return Σ_m φ_jm w_jm over the groups that have weights (n, d)."""
        total = np.zeros_like(q)
        for group, functions in shapes.items():
            if group in weights:
                table = np.zeros(functions.shape[1:])
                table[self._mask(group)] = weights[group]
                total += (functions * table).sum(axis=2)
        return total

    def _of_places(self, group: str) -> bool:
        return group in CAMERA_GROUPS or group in SMOOTH_GROUPS

    def _offsets(self, p: FloatArray, q: FloatArray, weights: Weights) -> FloatArray:
        total = np.zeros_like(p)
        for group, values in weights.items():
            if self._of_places(group):
                total += self._offset_functions(group, p, q) @ values.reshape(-1, 3)
        return total

    def _mask(self, group: str) -> BoolArray:
        """Return the mask (d, m) of a group's functions that exist."""
        if group in self._still:
            return self._loads[group]
        if group == "gain":
            return np.ones((self.joints, 1), dtype=np.bool_)
        return np.repeat(~self._prismatic[:, None], 2, axis=1)

    def _reading_functions(self, group: str, q: FloatArray) -> FloatArray:
        """Return φ (n, d, m); of the order of 1 for revolute joints, of the positions' spread [m] for others."""
        if group == "gain":
            units = np.where(self._prismatic, self.scaling.scale, 1.0)
            return ((q - self.scaling.middle) / self.scaling.half * units)[..., None]
        turns = q if group == "eccentricity" else 2.0 * q
        return np.stack([np.cos(turns), np.sin(turns)], axis=-1)

    def _loaded_frames(self, chain: RigidChain, q: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the chain's frames (n, d+1, 4, 4), and the places of each joint's loads (n, d or 1, loads, 3)."""
        frames = chain.frames(q)
        points = frames[:, :, :3, 3]
        if self.scaling.load is not None:
            last = chain.fixed[-1]
            moment_arms = last[:3, :3].T @ (self.scaling.load - last[:3, 3])
            points = points.copy()
            points[:, -1] += frames[:, -1, :3, :3] @ moment_arms
        return frames, self._places(points)

    def _torques(self, group: str, frames: FloatArray, places: FloatArray) -> FloatArray:
        """Return torques (force, if prismatic) about each joint by unit weights at each load's place (n, d, 3 loads).

        z·((p − o) × e) = e·(z × (p − o)): a weight's torque is a component of the Jacobian of its place p, here along
        x, y, z of the frame in which gravity is constant. The positions' spread counts as the unit of length.
        """
        axes = np.einsum("nkij,kj->nki", frames[:, :-1, :3, :3], self.parameters.reference.axes)
        origins = frames[:, :-1, :3, 3]
        torques = np.cross(axes[:, :, None], places - origins[:, :, None]) / self.scaling.scale
        torques = np.where(self._prismatic[:, None, None], self.scaling.scale * axes[:, :, None], torques)
        if self._still[group]:
            torques = torques @ frames[:, self._still[group], :3, :3][:, None]
        return torques.reshape(*torques.shape[:2], 3 * torques.shape[2])

    def _places(self, points: FloatArray) -> FloatArray:
        """Return the places of each joint's loads (n, d or 1, loads, 3), from the frames' origins (n, d+1, 3)."""
        if self.joints <= _Settings.joints_with_own_loads:
            return points[:, None, 1:]
        beyond = np.cumsum(points[:, :0:-1], axis=1)[:, ::-1] / np.arange(self.joints, 0, -1)[:, None]
        return np.stack([beyond, np.broadcast_to(points[:, -1:], beyond.shape)], axis=2)

    def _load_mask(self, still: int) -> BoolArray:
        """Return True where a load (d, 3 loads) acts on a joint: loads beyond it; none before the fixed link."""
        if self.joints <= _Settings.joints_with_own_loads:
            acts = np.triu(np.ones((self.joints, self.joints), dtype=np.bool_))
        else:
            acts = np.ones((self.joints, 2), dtype=np.bool_)
        acts[:still] = False
        return np.repeat(acts, 3, axis=1)

    def _offset_functions(self, group: str, p: FloatArray, q: FloatArray) -> FloatArray:
        """Return ψ (n, m) of a camera or a smooth group."""
        if group in SMOOTH_GROUPS:
            weights = self._stack.joint_weights(q)[:, :, 1:].reshape(len(q), 2 * self.joints)
            return np.multiply.reduce(weights[:, self._products[group]], axis=2)
        s = (p - self.scaling.centre) / self.scaling.scale
        degree = CAMERA_GROUPS.index(group) + 1
        monomials = [s[:, list(c)].prod(axis=1) for c in itertools.combinations_with_replacement(range(3), degree)]
        return np.stack([np.ones(len(s)), *monomials] if degree == 1 else monomials, axis=1)


def _for_each_axis(functions: FloatArray) -> FloatArray:
    """Return derivatives (n, 3, 3 m) of Σ_m ψ_m w_m by the weights w (m, 3), flattened, from ψ (n, m)."""
    n, m = functions.shape
    derivatives = np.zeros((n, 3, 3 * m))
    for axis in range(3):
        derivatives[:, axis, axis::3] = functions
    return derivatives


def _products(prismatic: BoolArray, order: int) -> IntArray:
    """Return indices (count, order) of the joint functions in each product of `order` different joints.

    A revolute joint has two functions, a prismatic one has one.
    """
    sizes = [1 if slides else 2 for slides in prismatic]
    chosen = [
        [2 * joint + part for joint, part in zip(joints, parts, strict=True)]
        for joints in itertools.combinations(range(len(sizes)), order)
        for parts in itertools.product(*(range(sizes[joint]) for joint in joints))
    ]
    return np.array(chosen, dtype=np.intp).reshape(-1, order)
