"""The camera's pose in diagnosis.json, with its covariance."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
from scipy.spatial.transform import Rotation

from bodyschema.cli.recordings.diagnosis import ReportedDiagnosis, Source
from bodyschema.diagnosis.assess.stored import predicted_pose_covariance
from bodyschema.diagnosis.diagnosis import Diagnosis
from bodyschema.diagnosis.fit.background import Scales
from bodyschema.diagnosis.fit.fit import fitted
from bodyschema.diagnosis.fit.observations import Observations
from bodyschema.effects import Effect, Motion, Simulation
from bodyschema.recordings.recording import Recording
from bodyschema.robot.description import RobotDescription

DESK_ARM = Path(__file__).parents[2] / "examples" / "desk_arm" / "robot.toml"
SHIFT = [0.02, -0.03, 0.01, 0.3, -0.2, 0.4]
SIGMA_M = 1e-3


def found(
    robot: RobotDescription, truth: Simulation | None, seed: int, effects: tuple[Effect, ...]
) -> ReportedDiagnosis:
    """Return what is left of a diagnosis whose only unknowns are `effects`."""
    rng = np.random.default_rng(seed)
    q = rng.uniform(robot.lower, robot.upper, (60, len(robot.joints)))
    x = (truth or Simulation(robot)).positions(Motion(q, None, np.zeros(60, dtype=np.int64)))
    recording = Recording(joints=robot.joints, q=q, x=x + SIGMA_M * rng.normal(size=x.shape))
    nominal = Simulation(robot, effects)
    fit = fitted(Observations.of(recording, nominal), nominal, len(effects))
    return ReportedDiagnosis(cast(Diagnosis, SimpleNamespace(stored=fit)), Source(recording, "a test"), robot, ())


def test_covariance_of_the_pose_covers_the_truth() -> None:
    robot, squares = RobotDescription.load(DESK_ARM), []
    truth = Simulation(robot, (Effect.at(robot, "camera_pose", values=SHIFT),))
    true = robot.camera.pose @ truth.camera_pose
    for seed in range(12):
        pose = found(robot, truth, seed, (Effect.at(robot, "camera_pose"),)).hand_eye
        T = np.array(pose.matrix)
        turn = Rotation.from_matrix(T[:3, :3] @ true[:3, :3].T).as_rotvec()
        off = np.concatenate([T[:3, 3] - true[:3, 3], turn])
        squares.append(off @ np.linalg.solve(np.array(pose.covariance).reshape(6, 6), off))
    # Chi-squared with 6 degrees of freedom: 6 ± 1 in the mean of twelve.
    assert 3.0 < np.mean(squares) < 10.0


def test_unfitted_camera_pose_has_no_covariance() -> None:
    robot = RobotDescription.load(DESK_ARM)
    pose = found(robot, None, 0, ()).hand_eye
    assert pose.covariance is None
    np.testing.assert_allclose(pose.matrix, robot.camera.pose, atol=1e-12)


def test_covariance_of_predicted_poses_covers_the_truth() -> None:
    robot, squares = RobotDescription.load(DESK_ARM), []
    kinds = (("camera_pose", None), ("joint_offset", robot.joints[1]), ("tool_offset", None))
    unknown = tuple(Effect.at(robot, kind, where) for kind, where in kinds)
    truth = Simulation(robot, tuple(e.with_values(0.01 * (1.0 + np.arange(len(e.values)))) for e in unknown))
    motion = Motion.still(np.linspace(robot.lower, robot.upper, 9)[4][None])
    for seed in range(12):
        fit = found(robot, truth, seed, unknown).diagnosis.stored
        off = fit.simulation.positions(motion)[0] - truth.positions(motion)[0]
        cov = predicted_pose_covariance(fit)
        assert cov is not None
        assert np.allclose(cov, cov.T)
        assert np.linalg.eigvalsh(cov).min() > 0.0
        squares.append(off @ np.linalg.solve(cov[:3, :3], off))
    # Chi-squared with 3 degrees of freedom; a pose in the middle is predicted a little better than the mean of all.
    assert 0.7 < np.mean(squares) < 6.0


def test_predicted_pose_covariance_is_absent_without_fitted_effects() -> None:
    assert predicted_pose_covariance(found(RobotDescription.load(DESK_ARM), None, 0, ()).diagnosis.stored) is None


def test_tolerances_alone_have_a_covariance_of_predicted_poses() -> None:
    fit = found(RobotDescription.load(DESK_ARM), None, 0, ()).diagnosis.stored.with_tolerances(Scales())
    cov = predicted_pose_covariance(fit)
    assert cov is not None
    assert np.linalg.eigvalsh(cov).min() > 0.0


def test_predicted_rotation_variance_equals_joint_offset_variance() -> None:
    robot = RobotDescription.load(DESK_ARM)
    fit = found(robot, None, 0, (Effect.at(robot, "joint_offset", robot.joints[1]),)).diagnosis.stored
    cov = predicted_pose_covariance(fit)
    assert cov is not None
    np.testing.assert_allclose(np.trace(cov[3:, 3:]), fit.covariance[0, 0], rtol=1e-6)
