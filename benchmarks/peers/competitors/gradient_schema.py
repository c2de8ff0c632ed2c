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
from kbmaps.arrays import FloatArray

_UPDATES = 6000
_LINK_RATE = 0.5
_LAST_RATE_SHARE = 0.02


@dataclass
class BodySchema:
    """Axes (d, 3) and links (d + 1, 3) [m]; `length` [m] is the arm's scale, which makes axes and links comparable."""

    axes: FloatArray
    links: FloatArray
    length: float

    @classmethod
    def drawn(cls, chain: RigidChain) -> BodySchema:
        """A drawing in this form: axes and links as they stand with all joints at zero."""
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
        """A random arm about as large as the cloud of positions and with its centre where theirs is."""
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

    def step(self, q: FloatArray, x: FloatArray, rate: float) -> None:
        """One step for a pair q (d,), x (3,)."""
        turns = rotations(self.axes, q)
        before = np.empty((len(q) + 1, 3, 3))
        before[0] = np.eye(3)
        for k, turn in enumerate(turns):
            before[k + 1] = before[k] @ turn
        shares = np.einsum("kij,kj->ki", before, self.links)
        error = x - shares.sum(axis=0)
        # In the frame before each joint: the error; in the one after it: what the joint carries.
        error_here = np.einsum("kij,i->kj", before, error)
        carried = np.cumsum(shares[::-1], axis=0)[::-1][1:]
        carried = np.einsum("kij,ki->kj", before[1:], carried)
        a, u, v = self.axes, error_here[:-1], carried
        cosine, sine = np.cos(q)[:, None], np.sin(q)[:, None]
        along = np.einsum("ki,ki->k", a, v)[:, None] * u + np.einsum("ki,ki->k", u, a)[:, None] * v
        gradient = (1.0 - cosine) * along + sine * np.cross(v, u)
        gradient -= np.einsum("ki,ki->k", gradient, a)[:, None] * a
        # Normalised, so that a rate of 1 takes about the whole error away whatever the arm's size.
        mobility = len(self.links) + float(np.square(carried).sum()) / self.length**2
        self.links += rate / mobility * error_here
        self.axes += rate / mobility * gradient / self.length**2
        self.axes /= np.linalg.norm(self.axes, axis=1, keepdims=True)


def rotations(axes: FloatArray, angles: FloatArray) -> FloatArray:
    """Rotations (k, 3, 3) by angles (k,) about unit axes (k, 3), or all about one (3,)."""
    x, y, z = axes.T
    zero = np.zeros_like(x)
    cross = np.moveaxis(np.array([[zero, -z, y], [z, zero, -x], [-y, x, zero]]), (0, 1), (-2, -1))
    outer = axes[..., :, None] * axes[..., None, :]
    cosine, sine = np.cos(angles)[:, None, None], np.sin(angles)[:, None, None]
    return cosine * np.eye(3) + (1.0 - cosine) * outer + sine * cross


def learn(problem: Problem, earlier: Fitted | None) -> Fitted:
    if isinstance(earlier, BodySchema):
        schema = copy.deepcopy(earlier)
    else:
        schema = BodySchema.random(problem) if problem.drawing is None else BodySchema.drawn(problem.drawing)
    passes = -(-_UPDATES // problem.pairs)
    order = np.concatenate([problem.rng.permutation(problem.pairs) for _ in range(passes)])[:_UPDATES]
    rates = _LINK_RATE * np.maximum(1.0 - np.arange(_UPDATES) / _UPDATES, _LAST_RATE_SHARE)
    for index, rate in zip(order, rates, strict=True):
        schema.step(problem.q[index], problem.x[index], rate)
    return schema


COMPETITOR = Competitor(
    "hersch",
    "Gradient body schema",
    "peer",
    learn,
    "Online gradient descent on joint axes and links (Hersch, Sauser and Billard 2008), normalised steps falling over "
    "6,000 updates in passes over the pairs; from the drawing, or from one random arm.",
)
