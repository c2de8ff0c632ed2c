"""Online gradient learning of a body schema (Hersch, Sauser and Billard 2008, Int. J. Humanoid Robotics 5).

The arm is a chain of rotations about axes a_k and links l_k: x = l_0 + R_1 (l_1 + R_2 (l_2 + …)). Each pair moves axes
and links down the gradient of its squared error; the axes are made unit vectors again.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass

import numpy as np

from benchmarks.peers.problem import Competitor, Fitted, Problem
from kbmaps import RigidChain
from kbmaps.arrays import FloatArray, IntArray
from kbmaps.rotations import cross_matrix

_UPDATES = 6000
_LINK_RATE = 0.5
_LAST_RATE_SHARE = 0.02
# The components of a cross product: v × u = v[after] u[after next] − v[after next] u[after].
_AFTER, _AFTER_NEXT = np.array([1, 2, 0]), np.array([2, 0, 1])
_CROSS = cross_matrix(np.eye(3)).reshape(3, 9)


@dataclass
class BodySchema:
    """Axes (d, 3) and links (d + 1, 3) [m]; `length` [m] is the arm's scale, which makes axes and links comparable."""

    axes: FloatArray
    links: FloatArray
    length: float

    @classmethod
    def drawn(cls, chain: RigidChain) -> BodySchema:
        """Convert a nominal model: axes and links with all joints at zero."""
        transform = np.eye(4)
        axes, points = [], [np.zeros(3)]
        for fixed, axis in zip(chain.fixed[:-1], chain.axes, strict=True):
            transform = transform @ fixed
            axes.append(transform[:3, :3] @ axis)
            points.append(transform[:3, 3])
        points.append((transform @ chain.fixed[-1])[:3, 3])
        links = np.diff(points, axis=0)
        return cls(np.array(axes), links, float(np.linalg.norm(links, axis=1).mean()))

    @classmethod
    def random(cls, problem: Problem) -> BodySchema:
        """Sample a random arm about as large as the cloud of positions, with the same centre."""
        size = float(np.linalg.norm(problem.x - problem.x.mean(axis=0), axis=1).mean())
        axes = problem.rng.normal(size=(problem.joints, 3))
        axes /= np.linalg.norm(axes, axis=1, keepdims=True)
        links = size / np.sqrt(problem.joints) * problem.rng.normal(size=(problem.joints + 1, 3)) / np.sqrt(3.0)
        schema = cls(axes, links, size / np.sqrt(problem.joints))
        schema.links[0] += (problem.x - schema.predict(problem.q)).mean(axis=0)
        return schema

    def predict(self, q: FloatArray) -> FloatArray:
        x = np.broadcast_to(self.links[-1], (len(q), 3))
        for k in range(len(self.axes) - 1, -1, -1):
            x = self.links[k] + np.einsum("nij,nj->ni", rotations(self.axes[k], q[:, k]), x)
        return x

    def learn(self, q: FloatArray, x: FloatArray, order: IntArray, rates: FloatArray) -> None:
        """Take one step for each pair in `order`, from q (n, d) and x (n, 3), at its rate."""
        step = _Stepper(self)
        cosines, sines = np.cos(q)[..., None], np.sin(q)[..., None]
        for index, rate in zip(order.tolist(), rates.tolist(), strict=True):
            step(cosines[index], sines[index], x[index], rate)


class _Stepper:
    """In-place gradient steps of a schema, pair by pair, in preallocated memory."""

    def __init__(self, schema: BodySchema) -> None:
        self.axes, self.links = schema.axes, schema.links
        self.scale = 1.0 / schema.length**2
        joints = len(schema.axes)
        self.turns = np.empty((joints, 3, 3))
        # Rotations in front of each joint and, last, of the marker.
        self.before = np.empty((joints + 1, 3, 3))
        self.before[0] = np.eye(3)
        self.products = [(self.before[k], self.turns[k], self.before[k + 1]) for k in range(joints)]

    def __call__(self, cosine: FloatArray, sine: FloatArray, x: FloatArray, rate: float) -> None:
        """Take one step for cosines and sines (d, 1) of a pair's angles and its position x (3,)."""
        axes, links, before = self.axes, self.links, self.before
        versine = 1.0 - cosine
        # Rodrigues: R = a aᵀ (1 − cos q) + sin q [a]× + cos q 1
        np.multiply((versine * axes)[:, :, None], axes[:, None, :], out=self.turns)
        flat = self.turns.reshape(-1, 9)
        flat += (sine * axes) @ _CROSS
        flat[:, ::4] += cosine
        for first, turn, product in self.products:
            np.matmul(first, turn, out=product)
        shares = (before @ links[:, :, None])[:, :, 0]
        beyond = np.add.accumulate(shares[::-1])[::-1]
        # The error in the frame before each joint; the carried vector in the frame after it.
        u = (x - beyond[0]) @ before
        v = (beyond[1:, None] @ before[1:])[:, 0]
        u_joints = u[:-1]
        gradient = (versine * np.vecdot(axes, v)[:, None]) * u_joints
        gradient += (versine * np.vecdot(axes, u_joints)[:, None]) * v
        gradient += (sine * v.take(_AFTER, axis=1)) * u_joints.take(_AFTER_NEXT, axis=1)
        gradient -= (sine * v.take(_AFTER_NEXT, axis=1)) * u_joints.take(_AFTER, axis=1)
        gradient -= np.vecdot(gradient, axes)[:, None] * axes
        # Normalised, so that a rate of 1 removes about the whole error, whatever the arm's size.
        pace = rate / (len(links) + float(np.vdot(v, v)) * self.scale)
        links += pace * u
        axes += (pace * self.scale) * gradient
        axes /= np.sqrt(np.vecdot(axes, axes))[:, None]


def rotations(axes: FloatArray, angles: FloatArray) -> FloatArray:
    """Return rotations (k, 3, 3) by angles (k,) about unit axes (k, 3), or all about one (3,)."""
    outer = axes[..., :, None] * axes[..., None, :]
    cosine, sine = np.cos(angles)[:, None, None], np.sin(angles)[:, None, None]
    return cosine * np.eye(3) + (1.0 - cosine) * outer + sine * cross_matrix(axes)


def learn(problem: Problem, earlier: Fitted | None) -> Fitted:
    if isinstance(earlier, BodySchema):
        schema = copy.deepcopy(earlier)
    else:
        schema = BodySchema.random(problem) if problem.drawing is None else BodySchema.drawn(problem.drawing)
    passes = -(-_UPDATES // problem.pairs)
    order = np.concatenate([problem.rng.permutation(problem.pairs) for _ in range(passes)])[:_UPDATES]
    rates = _LINK_RATE * np.maximum(1.0 - np.arange(_UPDATES) / _UPDATES, _LAST_RATE_SHARE)
    schema.learn(problem.q, problem.x, order, rates)
    return schema


COMPETITOR = Competitor(
    "hersch",
    "Gradient body schema",
    "peer",
    learn,
    "Online gradient descent on joint axes and links (Hersch, Sauser and Billard 2008), normalised steps falling over "
    "6,000 updates in passes over the pairs; from the drawing, or from one random arm.",
)
