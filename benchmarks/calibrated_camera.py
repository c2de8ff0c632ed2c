"""One calibrated camera and a tag measured with a caliper: errors of the learnt arm and its claimed uncertainty.

Run `python -m benchmarks.calibrated_camera [--arms N] [--pairs N] [--online N]`. Arm and camera are those of
`benchmarks.one_camera`. For each arm the camera is calibrated from 20 views of a board, whose corners have 0.05 px of
noise, and the tag's side is off by 0.1 mm (1-sigma). Corners of the tag have 0.012 px of noise. Nothing is rendered.
The truth is expressed in the frame that the calibration defines: the rotation that fits it best over the view is taken
out.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable, Sequence

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.one_camera import CAMERA, DRAWN, SIDE_M, TEST_POSES, Arm
from benchmarks.tables import Column, Table, tables_option
from bodyschema.interfaces.records import FloatArray, Pair, frozen_array
from bodyschema.learning.config import LearnerConfig
from bodyschema.learning.nominal import NominalModel
from bodyschema.learning.online_learner import OnlineLearner
from bodyschema.learning.solvers.solver import DirectSolver
from bodyschema.vision.board import Board, Corners
from bodyschema.vision.calibration.calibrate import CalibrationRequest, calibrate
from bodyschema.vision.calibration.view import View
from bodyschema.vision.pose import PoseEstimator, Sighting
from bodyschema.vision.rig.common_error import CommonError
from bodyschema.vision.rig.lens import Lens
from bodyschema.vision.rig.rectified import Rectification
from bodyschema.vision.rig.stereo_rig import Rig
from bodyschema.vision.tags.body import TAG_CORNERS
from kbmaps import RigidLearner

LENS = Lens("pinhole", (CAMERA.focal_px, CAMERA.focal_px), CAMERA.principal_point_px, 5 * (0.0,))
BOARD, VIEWS, BOARD_PX, TAG_PX, SIDE_SIGMA_M = Board(), 20, 0.05, 0.012, 0.0001


def calibrated(rng: np.random.Generator) -> Rig:
    """Return the camera's calibration from tilted views of the board all over the image, 0.3 to 0.6 m away."""
    views, middle, size = list[View](), BOARD.corners_m.mean(axis=0), np.array(CAMERA.image_size_px)
    while len(views) < VIEWS:
        turn = Rotation.from_rotvec(rng.uniform(-1.0, 1.0, 3) * (0.6, 0.6, 0.3)).as_matrix()
        ahead = (rng.uniform(0.0, size) - CAMERA.principal_point_px) / CAMERA.focal_px
        x = (BOARD.corners_m - middle) @ turn.T + rng.uniform(0.3, 0.6) * np.append(ahead, 1.0)
        px = LENS.project(x) + BOARD_PX * rng.standard_normal((len(x), 2))
        seen = np.flatnonzero(((px > 5.0) & (px < size - 6.0)).all(axis=1))
        if len(seen) >= 12:
            views.append(View(str(len(views)), Corners(seen, px[seen]), None))
    return calibrate(views, BOARD, CalibrationRequest(CAMERA.image_size_px, ("",), "", model="pinhole")).rig


def measured(arm: Arm, q: FloatArray, rig: Rig, side_m: float, rng: np.random.Generator) -> tuple[FloatArray, ...]:
    """Return positions (n, 3) [m] of the tag and their covariances, from the calibration and the stated side."""
    rectification, x, cov = Rectification(rig), [], []
    cov_px = (TAG_PX * rectification.calibration.focal_px / CAMERA.focal_px) ** 2 * np.eye(8)
    for pose in arm.true.poses(q):
        rotation = pose[:3, :3] @ arm.turn
        px = LENS.project(side_m * TAG_CORNERS @ rotation.T + pose[:3, 3]) + TAG_PX * rng.standard_normal((4, 2))
        sighting = Sighting(SIDE_M * TAG_CORNERS, rectification.points(px, 0), cov_px, right=False)
        fix = PoseEstimator(rectification.calibration, [sighting]).refine(rotation, pose[:3, 3])
        assert fix is not None
        x.append(fix.x)
        cov.append(fix.cov[3:, 3:])
    return np.array(x), np.array(cov)


def frame_turn(rig: Rig) -> FloatArray:
    """Return the rotation (3, 3) from the lens's true frame to the frame that its calibration defines."""
    u, v = np.meshgrid(*np.linspace((0.0, 0.0), np.array(CAMERA.image_size_px) - 1.0, 9).T)
    px = np.column_stack([u.ravel(), v.ravel()])
    true, meant = (np.column_stack([lens.directions(px), np.ones(len(px))]) for lens in (LENS, rig.left))
    return Rotation.align_vectors(meant, true)[0].as_matrix()


def online(
    arm: Arm, q: FloatArray, x: FloatArray, cov: FloatArray, common: Callable[[FloatArray], FloatArray] | None
) -> OnlineLearner:
    """Return the learner that runs beside the sampler, after it has learnt these pairs."""
    nominal = NominalModel(arm.nominal, arm.lower, arm.upper, pose_known=False, marker_known=False)
    learner = OnlineLearner(nominal, LearnerConfig(), DirectSolver(), common=common)
    for k in range(len(q)):
        pair = Pair("one", k + 1, 1, k / 30.0, "", frozen_array(q[k]), frozen_array(x[k]), frozen_array(cov[k]))
        learner.learn(pair, pair.t)
        while k % 30 == 29 and learner.work():
            pass
    return learner


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--arms", type=int, default=100)
    parser.add_argument("--pairs", type=int, default=60)
    parser.add_argument("--online", type=int, default=0, help="arms that the online learner learns too")
    tables_option(parser)
    given = parser.parse_args()
    rows: dict[str, list[tuple[float, ...]]] = {}
    for seed in range(given.arms):
        rng = np.random.default_rng([20261126, seed])
        arm = Arm(rng)
        q, test = arm.postures(given.pairs, rng), arm.postures(TEST_POSES, rng)
        rig, side_m = calibrated(rng), SIDE_M + SIDE_SIGMA_M * rng.standard_normal()
        x, cov = measured(arm, q, rig, side_m, rng)
        truth, error = arm.true.positions(test) @ frame_turn(rig).T, CommonError(rig, SIDE_SIGMA_M / SIDE_M)

        def judge(name: str, predicted: FloatArray, sigma: FloatArray, truth: FloatArray = truth) -> None:
            rows.setdefault(name, []).append(figures(predicted - truth, sigma))

        alone, told = (RigidLearner(arm.nominal, DRAWN) for _ in range(2))
        alone.learn(q, x, cov=cov)
        told.learn(q, x, cov=cov, common=error.errors(alone.predict(q)))
        for name, learner in (("covariances of the fixes", alone), ("and what all fixes share", told)):
            estimate = learner.estimate(test)
            judge(f"`RigidLearner`, {name}", estimate.x, estimate.sigma)
        if seed < given.online:
            for name, common in (("covariances of the fixes", None), ("and what all fixes share", error.variance)):
                prediction = online(arm, q, x, cov, common).snapshot.predict(test)
                judge(f"beside the sampler, {name}", prediction.x, prediction.sigma)
    millimetres = [Column(what, "mm", "{:.2f}") for what in ("off by, RMS", "claimed")]
    within = Column("within 1 sigma, 2 sigma", "%", "{:.0f}, {:.0f}")
    columns = Column("learner, and what it is given"), *millimetres, within, Column("arms", "", "{}")
    table = Table("webcam_calibrated", columns)
    for name, of_arms in rows.items():
        off_m, claimed_m, shares = means(of_arms)
        table.add(name, 1e3 * off_m, 1e3 * claimed_m, shares, len(of_arms))
    table.save(given.tables)


def figures(off: FloatArray, sigma: FloatArray) -> tuple[float, ...]:
    """Return mean squares of errors and of claimed sigmas (n, 3) [m²], and the shares within 1 and 2 sigma."""
    squares = (np.square(off).sum(axis=1).mean(), np.square(sigma).sum(axis=1).mean())
    return *map(float, squares), *(float((np.abs(off) < times * sigma).mean()) for times in (1.0, 2.0))


def means(of_arms: Sequence[tuple[float, ...]]) -> tuple[float, float, tuple[float, float]]:
    """Return the RMS of some arms' errors and claims [m], and the shares within 1 and 2 sigma [%]."""
    off, claimed, once, twice = np.mean(of_arms, axis=0)
    return float(np.sqrt(off)), float(np.sqrt(claimed)), (100.0 * once, 100.0 * twice)


if __name__ == "__main__":
    main()
