"""Learning while pairs come in: a rough drawing, a noisy camera, one small step for each pair.

The normalised LMS rule moves the control points towards each new pair, at once and at a constant cost. It forgets no
pair's lesson by design, but noise stays in it; learning stored pairs again, in random order, gets more out of them.
"""

from __future__ import annotations

import numpy as np

from kbmaps import NLMS, ChainParameters, RigidChain, learning_bases

SIGMA = 0.01  # of the camera, each coordinate [m]
REACH = np.radians(80)


def drawn_arm() -> RigidChain:
    fixed = np.tile(np.eye(4), (5, 1, 1))
    fixed[1:, :3, 3] = [[0.1, 0.0, 0.2], [0.3, 0.0, 0.0], [0.25, 0.0, 0.0], [0.1, 0.05, 0.0]]
    axes = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
    return RigidChain(fixed, axes, np.zeros(4, dtype=bool))


def main() -> dict[str, float]:
    rng = np.random.default_rng(0)
    drawing = drawn_arm()
    # The arm as it was built: each of its parameters is off by some 3 degrees or 30 mm.
    parameters = ChainParameters(drawing)
    arm = parameters.chain(0.04 * rng.normal(size=parameters.size))
    poses = rng.uniform(-REACH, REACH, (500, 4))

    learner = NLMS(drawing.to_kbmap(learning_bases([-REACH] * 4, [REACH] * 4)))

    def error_mm() -> float:
        return 1e3 * float(np.linalg.norm(learner.map.predict(poses) - arm.positions(poses), axis=1).mean())

    errors = {"drawing": error_mm()}
    q = rng.uniform(-REACH, REACH, (1000, 4))
    x = arm.positions(q) + SIGMA * rng.normal(size=(1000, 3))
    for n, (angles, position) in enumerate(zip(q, x, strict=True), 1):
        learner.learn(angles, position)  # some 30 microseconds
        if n in (10, 100, 1000):
            errors[f"{n} samples"] = error_mm()
    quiet = NLMS(learner.map, mu0=0.05)  # small steps average the noise out
    quiet.replay(q, x, order=np.concatenate([rng.permutation(1000) for _ in range(20)]))
    learner = quiet
    errors["20 replays"] = error_mm()
    for when, error in errors.items():
        print(f"{when:>12}: {error:6.1f} mm from the truth, with {1e3 * SIGMA:.0f} mm of noise")
    return errors


if __name__ == "__main__":
    main()
