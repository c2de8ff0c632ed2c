"""The same hand-guided path through every driver gives the same learnt model, to within the encoders' resolution."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from bench_arm import TICK, Arm
from feetech_arm import FeetechArm
from test_serial_lines import BoardArm

from interfaces.records import JointReading
from kbmaps import ExactLearner, JointBasis, KBMap, RigidChain

LIMITS = [(-2.0, 2.0)] * 3
FREQUENCIES = (0.71, 0.53, 0.37)  # in no simple ratio: the path goes everywhere
PATHS = [lambda t, k=k, w=w: 1.0 * math.sin(w * t + k) for k, w in enumerate(FREQUENCIES)]
REACH_M = 1.0  # of the arm below, at most
COUNT, RATE_HZ = 2000, 60.0


def chain() -> RigidChain:
    fixed = np.tile(np.eye(4), (4, 1, 1))
    fixed[1:, :3, 3] = [[0.3, 0.0, 0.1], [0.0, 0.25, 0.0], [0.2, 0.0, 0.05]]
    axes = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
    return RigidChain(fixed, axes, np.zeros(3, dtype=bool))


def true_angles(readings: list[JointReading]) -> np.ndarray:
    return np.array([[path(reading.t) for path in PATHS] for reading in readings])


def readings_of(joints) -> list[JointReading]:
    with joints:
        readings = [joints.read(1.0) for _ in range(COUNT)]
    return [reading for reading in readings if reading is not None]


def learnt(q: np.ndarray, x: np.ndarray) -> KBMap:
    bases = (JointBasis.orthonormal(-1.0, 1.0),) * 3
    learner = ExactLearner(KBMap(bases, np.zeros((3, 3, 3, 3))))
    learner.learn(q, x)
    return learner.solve().map


SOURCES: dict[str, Callable[[], object]] = {
    "Dynamixel": lambda: Arm(paths=PATHS, limits=LIMITS, latency_s=1e-3, rate_hz=RATE_HZ).joints,
    "Feetech": lambda: FeetechArm(paths=PATHS, limits=LIMITS, latency_s=1e-3, rate_hz=RATE_HZ).joints,
    "serial lines": lambda: BoardArm(PATHS, limits=LIMITS, latency_s=1e-3, rate_hz=RATE_HZ).joints,
}


@pytest.mark.parametrize("source", SOURCES)
def test_the_same_path_gives_the_same_model_whatever_reads_the_joints(source) -> None:
    readings = readings_of(SOURCES[source]())
    q, arm = true_angles(readings), chain()
    x = arm.positions(q)  # a camera without errors, at the readings' times
    through_driver, simulated = learnt(np.array([reading.q for reading in readings]), x), learnt(q, x)
    poses = q[::50]
    apart = np.linalg.norm(through_driver.predict(poses) - simulated.predict(poses), axis=1)
    assert apart.max() < TICK * REACH_M
