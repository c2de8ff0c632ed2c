"""Random rigid chains, and the paper's formulas written out literally, for the tests of kbmaps."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from kbmaps import JointBasis, KBMap, RigidChain, learning_bases

LINK_M = 0.15


def random_chain(rng: np.random.Generator, kinds: str) -> RigidChain:
    """Return a chain with one joint for each letter of `kinds`: R revolute, P prismatic."""
    joints = len(kinds)
    fixed = np.tile(np.eye(4), (joints + 1, 1, 1))
    fixed[:, :3, :3] = Rotation.random(joints + 1, rng=rng).as_matrix()
    fixed[:, :3, 3] = LINK_M * rng.normal(size=(joints + 1, 3))
    axes = rng.normal(size=(joints, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    return RigidChain(fixed, axes, np.array([kind == "P" for kind in kinds]))


def half_ranges(kinds: str, revolute_deg: float) -> np.ndarray:
    """Return half ranges (d,): revolute_deg for a revolute joint [rad], 0.3 m for a prismatic one."""
    return np.array([np.radians(revolute_deg) if kind == "R" else 0.3 for kind in kinds])


def random_q(rng: np.random.Generator, kinds: str, n: int, revolute_deg: float) -> np.ndarray:
    reach = half_ranges(kinds, revolute_deg)
    return rng.uniform(-reach, reach, (n, len(kinds)))


def bases_for(kinds: str, revolute_deg: float = 80.0) -> tuple[JointBasis, ...]:
    reach = half_ranges(kinds, revolute_deg)
    return learning_bases(-reach, reach, [kind == "P" for kind in kinds])


def random_map(rng: np.random.Generator, bases: Sequence[JointBasis]) -> KBMap:
    return KBMap(tuple(bases), rng.normal(size=(3, *(basis.size for basis in bases))))


def control_points_needed(kinds: str) -> int:
    return 3 ** kinds.count("R") * 2 ** kinds.count("P")


def literal_joint_weights(theta: float, alpha: float) -> np.ndarray:
    """Return the three normalised weights of one joint exactly as eqs. (9) and (10) print them."""
    tau = np.tan(theta / 2) / (2 * np.tan(alpha / 2)) + 0.5
    gamma = np.array([1.0, np.cos(alpha), 1.0])
    bernstein = np.array([(1 - tau) ** 2, 2 * tau * (1 - tau), tau**2])
    return gamma * bernstein / (gamma * bernstein).sum()


def literal_weights(q: np.ndarray, alpha: float) -> np.ndarray:
    """Return the weight vector w of eq. (15) for all joints: products over the joints in index order."""
    w = np.ones(1)
    for theta in q:
        w = np.array([a * b for a in w for b in literal_joint_weights(theta, alpha)])
    return w
