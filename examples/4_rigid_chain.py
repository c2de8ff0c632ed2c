"""Thirty noisy pairs calibrate an arm: camera, tool and joint zeros with 95 % intervals.

A rigid chain has few parameters, so few pairs are enough. The drawing is the prior: tolerances say how far the real
arm may be from it. What no motion can show (the first zero is a turn of the camera) rests on them, and is named.
"""

from __future__ import annotations

import numpy as np

from kbmaps import ChainParameters, ChainReport, ChainTolerances, RigidChain, RigidLearner

SIGMA = 0.001  # of the camera, each coordinate [m]
REACH = np.radians(90)


def drawn_arm() -> RigidChain:
    fixed = np.tile(np.eye(4), (7, 1, 1))
    fixed[1:, :3, 3] = [[0, 0, 0.3], [0.3, 0, 0], [0.25, 0, 0], [0.1, 0.05, 0], [0, 0, 0.1], [0.03, 0, 0.1]]
    axes = np.array([[0, 0, 1.0], [0, 1.0, 0], [0, 1.0, 0], [1.0, 0, 0], [0, 1.0, 0], [1.0, 0, 0]])
    return RigidChain(fixed, axes, np.zeros(6, dtype=bool))


def main() -> tuple[ChainReport, np.ndarray, float]:
    rng = np.random.default_rng(0)
    drawing = drawn_arm()
    # Well-made parts, joints whose zeros were set by eye, a camera and a tool placed by hand.
    tolerances = ChainTolerances(
        axes=0.001, points=0.0005, zeros=0.05, tool=0.03, base_rotation=0.05, base_translation=0.05
    )
    parameters = ChainParameters(drawing)
    change = parameters.standard_deviations(tolerances) * rng.normal(size=parameters.size)

    q = rng.uniform(-REACH, REACH, (30, 6))
    learner = RigidLearner(drawing, tolerances)
    learner.learn(q, parameters.positions(change, q) + SIGMA * rng.normal(size=(30, 3)))
    report = learner.report()

    true_zeros = np.degrees(change[parameters.zeros])
    print("joint zeros [deg]      learnt             true")
    for k, true in enumerate(true_zeros):
        learnt, half = np.degrees([report.zeros.value[k], report.zeros.half_width[k]])
        print(f"  joint {k + 1}        {learnt:7.3f} ± {half:5.3f}   {true:8.3f}")
    print("tool moved by [mm]", np.round(1e3 * report.tool_shift.value, 1), "±", end=" ")
    print(np.round(1e3 * report.tool_shift.half_width, 1), "true", np.round(1e3 * change[parameters.tool], 1))
    print(f"noise {1e3 * report.noise:.2f} mm (true {1e3 * SIGMA:.2f}), {report.outliers} outliers")

    poses = rng.uniform(-REACH, REACH, (500, 6))
    off = np.linalg.norm(learner.predict(poses) - parameters.positions(change, poses), axis=1)
    print(f"mean error on other poses {1e3 * off.mean():.2f} mm")
    return report, true_zeros, float(off.mean())


if __name__ == "__main__":
    main()
