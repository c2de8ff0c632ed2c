"""Benefit of weighting each direction of a position by its covariance in the online learner.

Run `python -m benchmarks.directions [--arms N] [--pairs N ...] [--joints 4|6] [--eyes 1|2] [--encoder DEG] [--alike]`.
The arm is the desk arm of `benchmarks.one_camera` or one of six joints, seen by that benchmark's camera. The camera's
pose and the marker's position are unknown. `--alike` states the same variance in all directions.

One eye: covariances from the corners of a tag, 0.05 px each. The depth is taken to be 2.5 times more certain than the
corners alone determine it, which is what the tag's edges achieve: a tenth of the certainty across the line of sight.
Two eyes: a baseline of 250 mm, 0.1 px.
"""

from __future__ import annotations

import argparse
import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.calibrated_camera import figures, means
from benchmarks.one_camera import CAMERA, DRAWN, PLACED, SIDE_M, Arm
from benchmarks.tables import Column, Table, tables_option
from bodyschema.interfaces.records import FloatArray, Pair, frozen_array
from bodyschema.learning.config import LearnerConfig
from bodyschema.learning.nominal import NominalModel
from bodyschema.learning.online_learner import OnlineLearner
from bodyschema.learning.snapshot import Snapshot
from bodyschema.learning.solvers.solver import DirectSolver
from bodyschema.vision.pose import PoseEstimator, Sighting
from bodyschema.vision.tags.body import TAG_CORNERS
from kbmaps import ChainParameters, RigidChain

TAG_PX, SURER_DEPTH = 0.05, 2.5
PAIR_PX, BASELINE_M = 0.1, 0.25
TEST_POSES, SOLVE_EVERY = 400, 50
PLACES_M = [(0, 0, 0.089), (0, 0.06, 0), (0, 0, 0.2125), (0, 0, 0.196), (0, 0.05, 0), (0, 0, 0.0947), (0.02, 0, 0.06)]
AXES = np.array([[0, 0, 1], [0, 1, 0], [0, 1, 0], [0, 1, 0], [0, 0, 1], [0, 1, 0]], dtype=np.float64)
LIMITS_DEG = (150.0, 90.0, 130.0, 120.0, 170.0, 120.0)


class SixJoints(Arm):
    """An arm of six joints in front of the desk arm's camera, with the same errors of its nominal model."""

    def __init__(self, rng: np.random.Generator) -> None:
        fixed = np.tile(np.eye(4), (7, 1, 1))
        fixed[:, :3, 3] = PLACES_M
        fixed[0] = PLACED @ fixed[0]
        self.nominal = RigidChain(fixed, axes=AXES, prismatic=np.zeros(6, dtype=np.bool_))
        self.upper = np.radians(LIMITS_DEG)
        self.lower = -self.upper
        parameters = ChainParameters(self.nominal)
        self.true = parameters.chain(parameters.standard_deviations(DRAWN) * rng.standard_normal(parameters.size))
        q = rng.uniform(self.lower, self.upper, (4000, 6))
        turns = Rotation.create_group("O").as_matrix()
        self.turn = max(turns, key=lambda turn: int(self._shown(q, turn).sum()))


def one_eye(arm: Arm, q: FloatArray) -> FloatArray:
    """Return covariances (n, 3, 3) [m²] of a tag's position."""
    found = np.empty((len(q), 3, 3))
    for row, pose in enumerate(arm.true.poses(q)):
        rotation = pose[:3, :3] @ arm.turn
        px = CAMERA.project(SIDE_M * TAG_CORNERS @ rotation.T + pose[:3, 3])[:, :2]
        sighting = Sighting(SIDE_M * TAG_CORNERS, px, TAG_PX**2 * np.eye(8), right=False)
        fix = PoseEstimator(CAMERA, [sighting]).refine(rotation, pose[:3, 3])
        assert fix is not None
        values, axes = np.linalg.eigh(fix.cov[3:, 3:])
        values[2] /= SURER_DEPTH**2
        found[row] = (axes * values) @ axes.T
    return found


def two_eyes(arm: Arm, q: FloatArray) -> FloatArray:
    """Return covariances (n, 3, 3) [m²] of a ball's position."""
    x = arm.true.positions(q)
    sight = x / np.linalg.norm(x, axis=1)[:, None]
    along = sight[:, :, None] * sight[:, None, :]
    across_m = PAIR_PX * x[:, 2] / CAMERA.focal_px / np.sqrt(2.0)
    depth_m = PAIR_PX * np.square(x[:, 2]) / CAMERA.focal_px / BASELINE_M * np.sqrt(2.0)
    return across_m[:, None, None] ** 2 * (np.eye(3) - along) + depth_m[:, None, None] ** 2 * along


def snapshots(arm: Arm, q: FloatArray, x: FloatArray, cov: FloatArray, counts: list[int]) -> list[Snapshot]:
    """Learn the pairs in order; return the learner's snapshot after each number of pairs in `counts`."""
    nominal = NominalModel(arm.nominal, arm.lower, arm.upper, pose_known=False, marker_known=False)
    settings = LearnerConfig(replays_per_pair=1.0, solve_every=SOLVE_EVERY)
    learner, found = OnlineLearner(nominal, settings, DirectSolver()), list[Snapshot]()
    for k in range(len(q)):
        pair = Pair("one", k + 1, 1, k / 30.0, "", frozen_array(q[k]), frozen_array(x[k]), frozen_array(cov[k]))
        learner.learn(pair, pair.t)
        while (k + 1 in counts or k % SOLVE_EVERY == SOLVE_EVERY - 1) and learner.work():
            pass
        if k + 1 in counts:
            found.append(learner.snapshot)
    return found


def measured(given: argparse.Namespace, joints: int, eyes: int) -> list[object]:
    """Return the figures of one kind of arm, the errors [µm] and the coverage [%] after each number of pairs."""
    rows: list[list[tuple[float, ...]]] = [[] for _ in given.pairs]
    for seed in range(given.arms):
        rng = np.random.default_rng([77, joints, seed])
        arm = (Arm if joints == 4 else SixJoints)(rng)
        rng = np.random.default_rng([78, joints, seed])
        q, test = arm.postures(given.pairs[-1], rng), arm.postures(TEST_POSES, rng)
        cov, truth = (one_eye if eyes == 1 else two_eyes)(arm, q), arm.true.positions(test)
        x = arm.true.positions(q) + np.matvec(np.linalg.cholesky(cov), rng.standard_normal((len(q), 3)))
        q = q + np.radians(given.encoder) * rng.standard_normal(q.shape)
        if given.alike:
            cov = np.trace(cov, axis1=1, axis2=2)[:, None, None] / 3.0 * np.eye(3)
        for row, snapshot in zip(rows, snapshots(arm, q, x, cov, given.pairs), strict=True):
            found = snapshot.predict(test)
            row.append(figures(found.x - truth, found.sigma))
    cells: list[object] = []
    for row in rows:
        off_m, _, shares = means(row)
        cells += [1e6 * off_m, shares]
    return cells


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--arms", type=int, default=12)
    parser.add_argument("--pairs", type=int, nargs="+", default=[150, 300], help="ascending")
    parser.add_argument("--joints", type=int, nargs="+", choices=(4, 6), default=[4, 6])
    parser.add_argument("--eyes", type=int, nargs="+", choices=(1, 2), default=[1, 2])
    parser.add_argument("--encoder", type=float, default=0.0, help="1-sigma of a joint's reading [°]")
    parser.add_argument("--alike", action="store_true")
    tables_option(parser)
    given = parser.parse_args()
    columns = [Column("joints", "", "{}"), Column("cameras", "", "{}")]
    for count in given.pairs:
        columns += [
            Column(f"{count} pairs: off by, RMS", "µm", "{:.0f}"),
            Column("within 1 sigma, 2 sigma", "%", "{:.0f}, {:.0f}"),
        ]
    table = Table("webcam_directions", columns)
    for eyes in given.eyes:
        for joints in given.joints:
            table.add(joints, eyes, *measured(given, joints, eyes))
    table.save(given.tables)


if __name__ == "__main__":
    main()
