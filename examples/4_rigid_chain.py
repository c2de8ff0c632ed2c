"""Calibrate an arm from thirty noisy pairs, then use the result: report, next pose, reach, save, write a URDF.

The nominal model is the prior: tolerances state how far the real arm may be from it. Parameters that are not
identifiable (the first offset is equivalent to a rotation of the camera) rest on the prior, and are reported.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np

from bodyschema.robot.calibrated import CalibratedGeometry
from bodyschema.robot.calibrated_files import write_calibrated
from bodyschema.robot.description import RobotDescription
from kbmaps import ChainParameters, ChainPosterior, ChainTolerances, InverseKinematics, RigidLearner, next_pose

SIGMA = 0.001  # of the camera, each coordinate [m]
ROBOT = Path(__file__).parent / "desk_arm" / "robot.toml"  # any RigidChain will do where no URDF is wanted


def main(folder: Path) -> dict[str, object]:
    rng = np.random.default_rng(0)
    robot = RobotDescription.load(ROBOT)
    # Well-made parts, joints whose zeros were set by eye, a camera and a tool placed by hand.
    tolerances = ChainTolerances(
        axes=0.001, points=0.0005, zeros=0.05, tool=0.03, base_rotation=0.05, base_translation=0.05
    )
    parameters = ChainParameters(robot.chain)
    real = parameters.chain(parameters.standard_deviations(tolerances) * rng.normal(size=parameters.size))
    poses = rng.uniform(robot.lower, robot.upper, (500, 4))

    learner = RigidLearner(robot.chain, tolerances)
    learner.learn(poses[:30], real.positions(poses[:30]) + SIGMA * rng.normal(size=(30, 3)))
    print(report := learner.report())

    there = learner.estimate(poses[30])
    print("1-sigma of another pose [mm]", (1e3 * there.sigma).round(2), "near samples" if there.in_support else "far")
    q_next = next_pose(ChainPosterior.of(learner), region=poses, candidates=poses)
    print("the sample that would teach most is at [deg]", np.degrees(q_next).round())

    x = real.positions(poses[31])
    reached = InverseKinematics(learner, robot.lower, robot.upper).solve(x, start=poses[30])
    miss = np.linalg.norm(real.positions(reached.q) - x)
    print(f"inverse kinematics: {reached.reason}, the real arm comes within {1e3 * miss:.1f} mm")

    (folder / "arm.kbpack").write_bytes(learner.to_bytes())
    again = RigidLearner.from_bytes((folder / "arm.kbpack").read_bytes())

    moved = {"T_measured_nominal": report.T_measured_nominal, "zeros": report.zeros.value}
    geometry = CalibratedGeometry.of(robot, again.chain, **moved)
    written = write_calibrated(robot, geometry, folder / "calibrated", "calibrated from 30 samples")
    return {"real": real, "report": report, "learner": learner, "again": again, "miss": miss, "written": written}


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        main(Path(folder))
