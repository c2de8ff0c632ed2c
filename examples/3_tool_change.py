"""Tool change: the arm stays known, and the tool's three numbers are relearnt within one second of camera frames.

A recursive rigid chain updates with each pair and stores none. On a tool change it forgets only the position of the
marker on the hand.
"""

from __future__ import annotations

import numpy as np

from kbmaps import ChainParameters, ChainTolerances, RecursiveRigidLearner, RigidChain

SIGMA = 0.005  # of the camera, each coordinate [m]
REACH = np.radians(80)


def drawn_arm() -> RigidChain:
    fixed = np.tile(np.eye(4), (7, 1, 1))
    fixed[1:, :3, 3] = [[0, 0, 0.3], [0.3, 0, 0], [0.25, 0, 0], [0.1, 0.05, 0], [0, 0, 0.1], [0.03, 0, 0.1]]
    axes = np.array([[0, 0, 1.0], [0, 1.0, 0], [0, 1.0, 0], [1.0, 0, 0], [0, 1.0, 0], [1.0, 0, 0]])
    return RigidChain(fixed, axes, np.zeros(6, dtype=bool))


def main() -> dict[str, float]:
    rng = np.random.default_rng(0)
    drawing = drawn_arm()
    rough = ChainTolerances(axes=np.radians(3.0), points=0.015, tool=0.03)
    parameters = ChainParameters(drawing)
    arm = parameters.chain(parameters.standard_deviations(rough) * rng.normal(size=parameters.size))
    poses = rng.uniform(-REACH, REACH, (500, 6))
    learner = RecursiveRigidLearner(drawing, rough, noise=SIGMA)
    errors: dict[str, float] = {}

    def judge(what: str) -> None:
        errors[what] = 1e3 * float(np.linalg.norm(learner.predict(poses) - arm.positions(poses), axis=1).mean())
        print(f"{what:>28}: {errors[what]:6.1f} mm mean error on other poses")

    def learn(pairs: int) -> None:
        q = rng.uniform(-REACH, REACH, (pairs, 6))
        learner.learn(q, arm.positions(q) + SIGMA * rng.normal(size=(pairs, 3)))

    judge("drawing")
    learn(300)
    judge("first tool, 300 samples")

    arm = arm.with_tool([0.0, 0.0, 0.2])  # 200 mm longer
    judge("second tool, no sample of it")
    learner.tool_changed(0.2)
    learn(1)
    judge("second tool, 1 sample")
    learn(9)
    judge("second tool, 10 samples")
    learn(20)
    judge("second tool, 30 samples")
    return errors


if __name__ == "__main__":
    main()
