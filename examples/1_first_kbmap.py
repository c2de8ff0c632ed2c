"""A first Kinematic Bézier Map: an arm learnt exactly, everywhere, from as few poses as it has numbers.

A map of d turning joints holds any rigid arm with 3^d control points. That many poses determine them, wherever they
are: here all of them lie within ±60 degrees, and the map is right on the whole circle.
"""

from __future__ import annotations

import numpy as np

from kbmaps import ExactLearner, JointBasis, KBMap, RigidChain


def three_joints() -> RigidChain:
    """Return an arm with axes z, y and x; it stands in for the robot, and only its positions are used."""
    fixed = np.tile(np.eye(4), (4, 1, 1))
    fixed[1:, :3, 3] = [[0.3, 0.0, 0.1], [0.0, 0.25, 0.0], [0.2, 0.0, 0.05]]
    axes = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
    return RigidChain(fixed, axes, np.zeros(3, dtype=bool))


def main() -> float:
    rng = np.random.default_rng(0)
    arm, reach = three_joints(), np.radians(60)
    q = rng.uniform(-reach, reach, (3**3, 3))  # joint angles [rad]
    x = arm.positions(q)  # what a camera would measure [m]

    bases = (JointBasis.orthonormal(-reach, reach),) * 3
    nothing = KBMap(bases, np.zeros((3, 3, 3, 3)))  # x, y, z, each with 3 x 3 x 3 control points
    learner = ExactLearner(nothing)
    learner.learn(q, x)
    kbmap = learner.solve().map

    poses = rng.uniform(-np.pi, np.pi, (1000, 3))
    worst = float(np.linalg.norm(kbmap.predict(poses) - arm.positions(poses), axis=1).max())
    print(f"learnt from {len(q)} poses within ±60°: {kbmap.net.size} numbers")
    print(f"at the zero pose the marker is at {np.round(kbmap.predict(np.zeros(3)), 6)} m")
    print(f"worst error over 1,000 poses on the whole circle: {worst:.1e} m")
    return worst


if __name__ == "__main__":
    main()
