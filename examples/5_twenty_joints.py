"""Twenty joints: a map with 3^20 control points cannot be stored, its arm can still be learnt from 150 pairs.

A humanoid has many joints between camera and hand. The rigid chain has 109 parameters here where the map would have
3.5 billion control points a coordinate; started from a rough drawing, it finds the arm.
"""

from __future__ import annotations

import time

import numpy as np

from kbmaps import ChainParameters, ChainTolerances, RigidChain, RigidLearner

JOINTS, PAIRS = 20, 150
REACH = np.radians(40)


def drawn_arm() -> RigidChain:
    """Return the nominal arm: links of 60 mm, axes in turn about z, y and x."""
    fixed = np.tile(np.eye(4), (JOINTS + 1, 1, 1))
    fixed[1:, :3, 3] = [0.05, 0.02, 0.03]
    return RigidChain(fixed, np.eye(3)[[2 - k % 3 for k in range(JOINTS)]], np.zeros(JOINTS, dtype=bool))


def main() -> dict[str, float]:
    rng = np.random.default_rng(0)
    drawing = drawn_arm()
    rough = ChainTolerances(axes=np.radians(3.0), points=0.01, tool=0.03)
    parameters = ChainParameters(drawing)
    change = parameters.standard_deviations(rough) * rng.normal(size=parameters.size)
    poses = rng.uniform(-REACH, REACH, (500, JOINTS))
    truth = parameters.positions(change, poses)

    def error_mm(x: np.ndarray) -> float:
        return 1e3 * float(np.linalg.norm(x - truth, axis=1).mean())

    figures = {"drawing": error_mm(drawing.positions(poses))}
    for sigma in (0.005, 0.0):
        q = rng.uniform(-REACH, REACH, (PAIRS, JOINTS))
        begin = time.perf_counter()
        learner = RigidLearner(drawing, rough)
        learner.learn(q, parameters.positions(change, q) + sigma * rng.normal(size=(PAIRS, 3)))
        figures[f"{1e3 * sigma:.0f} mm of noise"] = error_mm(learner.predict(poses))
        print(f"{PAIRS} samples with {1e3 * sigma:.0f} mm of noise learnt in {time.perf_counter() - begin:.1f} s")
    print(f"a KB-Map would have {3 * 3**JOINTS:,} numbers, the chain has {parameters.size}")
    for what, error in figures.items():
        print(f"{what:>14}: {error:.3g} mm mean error on other poses")
    return figures


if __name__ == "__main__":
    main()
