"""Hand-eye calibration of a wrist camera from a tag fixed in the world, compared with OpenCV's five methods.

Run `python -m benchmarks.hand_eye [--seeds N] [--views N] [--opencv4 PYTHON]`. OpenCV 5 has no `calibrateHandEye` in
Python: PYTHON is an interpreter with OpenCV 4; without it only this learner runs. Arm and encoders are exact, as
OpenCV's methods assume. The camera of the desk arm sits near the gripper and sees a tag of 50 mm from 0.3 to 0.8 m,
with 0.05 px of noise on its corners. All methods get the same views. Errors are those of T_flange_camera, RMS over the
seeds.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.tables import Column, Table, tables_option
from bodyschema.interfaces.camera import StereoCalibration
from bodyschema.interfaces.records import FloatArray
from bodyschema.robot.description import RobotDescription
from bodyschema.robot.toml_file import read_toml
from bodyschema.vision.pose import Pose, PoseEstimator, Sighting, initial_poses, mirrored
from bodyschema.vision.tags.body import TAG_CORNERS
from kbmaps import ChainTolerances, RigidChain, RigidLearner, align

ROBOT = Path(__file__).parent.parent / "examples" / "desk_arm" / "robot.toml"
CAMERA = StereoCalibration(600.0, (319.5, 239.5), 0.0, (640, 480), pixel_sigma=0.0)
CORNERS = 0.05 * TAG_CORNERS
CORNER_PX = 0.05
EXACT, ANYWHERE = 1e-9, 1.0
KNOWN_ARM = ChainTolerances(
    axes=EXACT, points=EXACT, zeros=EXACT, tool=ANYWHERE, base_rotation=ANYWHERE, base_translation=ANYWHERE
)
METHODS = ("TSAI", "PARK", "HORAUD", "ANDREFF", "DANIILIDIS")
# Script run by the OpenCV 4 interpreter: lists of rotations and translations in, each method's result out.
ASKED = """
import cv2, json, sys
import numpy as np
views = [np.array(each) for each in json.load(sys.stdin)]
for name in sys.argv[1:]:
    turn, place = cv2.calibrateHandEye(*map(list, views), method=getattr(cv2, f"CALIB_HAND_EYE_{name}"))
    print(json.dumps([turn.tolist(), place.ravel().tolist()]))
"""


def wrist_camera() -> RobotDescription:
    """Load the desk arm with a camera on its gripper and a marker fixed in the world."""
    tables, text = read_toml(ROBOT)
    turned = {"joints": tables["robot"]["joints"][::-1], "marker_link": "base_link", "marker_xyz": [0.0, 0.0, 0.0]}
    robot = tables["robot"] | turned | {"marker_known": False}
    camera = {"parent_link": "gripper", "pose_known": False}
    return RobotDescription.from_tables({"robot": robot, "camera": camera}, text, ROBOT)


def transform(turn: Rotation, shift: FloatArray) -> FloatArray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = turn.as_matrix(), shift
    return T


def seen(T_camera_tag: FloatArray, rng: np.random.Generator) -> Pose | None:
    """Estimate the tag's pose from its noisy corners; None if its tilt is ambiguous (a mirrored pose fits as well)."""
    x = CORNERS @ T_camera_tag[:3, :3].T + T_camera_tag[:3, 3]
    px = CAMERA.project(x)[:, :2] + CORNER_PX * rng.standard_normal((4, 2))
    estimator = PoseEstimator(CAMERA, [Sighting(CORNERS, px, CORNER_PX**2 * np.eye(8), right=False)])
    starts = [(R, x0) for R, x0 in initial_poses(CAMERA, CORNERS, px)]
    found = [estimator.refine(turn, x0) for R, x0 in starts for turn in (R, mirrored(R, x0))]
    poses = sorted((pose for pose in found if pose is not None), key=lambda pose: pose.squares)
    others = [each for each in poses if np.trace(each.rotation.T @ poses[0].rotation) < 1.0 + 2.0 * np.cos(0.05)]
    return None if others and others[0].squares - poses[0].squares < 12.0 else poses[0]


def views(
    robot: RobotDescription, T_gripper_camera: FloatArray, count: int, rng: np.random.Generator
) -> tuple[FloatArray, list[Pose], FloatArray]:
    """Return joint angles (n, d), the tag poses seen there, and the gripper's poses in the world (n, 4, 4)."""
    T_camera_gripper = np.linalg.inv(T_gripper_camera)
    q, poses, grippers = [], [], []
    T_world_tag = None
    while len(q) < count:
        angles = rng.uniform(robot.lower, robot.upper)
        # The nominal chain goes from the gripper, where the camera nominally sits, to the world.
        T_gripper_world = robot.chain.poses(angles[None])[0]
        if T_world_tag is None:
            # The tag is placed in front of the camera of the first view.
            ahead = transform(Rotation.from_rotvec([np.pi - 0.4, 0.2, 0.1]), np.array([0.0, 0.0, 0.5]))
            T_world_tag = np.linalg.inv(T_gripper_world) @ T_gripper_camera @ ahead
        T_camera_tag = T_camera_gripper @ T_gripper_world @ T_world_tag
        x = CORNERS @ T_camera_tag[:3, :3].T + T_camera_tag[:3, 3]
        if not (0.3 < T_camera_tag[2, 3] < 0.8 and T_camera_tag[2, 2] < -np.cos(np.radians(60.0))):
            continue
        px = CAMERA.project(x)[:, :2]
        if not ((px > 5.0) & (px < np.array(CAMERA.image_size_px) - 6.0)).all():
            continue
        pose = seen(T_camera_tag, rng)
        if pose is not None:
            q.append(angles)
            poses.append(pose)
            grippers.append(np.linalg.inv(T_gripper_world))
    return np.array(q), poses, np.array(grippers)


def learnt(
    nominal: RigidChain, q: FloatArray, poses: list[Pose], T_gripper_camera: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return T_gripper_camera (4, 4), and True (6,) for each of its numbers whose 95 % interval covers the truth."""
    x, cov = np.array([pose.x for pose in poses]), np.array([pose.cov[3:, 3:] for pose in poses])
    turns = np.array([pose.rotation for pose in poses])
    placed = align(nominal, q, x, pose_known=False, marker_known=False, turns=turns)
    learner = RigidLearner(placed.chain, KNOWN_ARM)
    learner.learn(q, x, cov=cov)
    report = learner.report()
    # The nominal camera pose is the gripper's own frame.
    left = np.linalg.inv(T_gripper_camera) @ np.linalg.inv(placed.T_measured_nominal)
    truth = np.concatenate([Rotation.from_matrix(left[:3, :3]).as_rotvec(), left[:3, 3]])
    low, high = (
        np.concatenate([getattr(report.base_rotation, end), getattr(report.base_translation, end)])
        for end in ("low", "high")
    )
    T: FloatArray = np.asarray(np.linalg.inv(report.T_measured_nominal @ placed.T_measured_nominal), dtype=np.float64)
    return T, ((low < truth) & (truth < high)).astype(np.float64)


def of_opencv(python: Path, grippers: FloatArray, poses: list[Pose]) -> dict[str, FloatArray]:
    """Return T_gripper_camera (4, 4) by each of OpenCV's methods."""
    views = [grippers[:, :3, :3], grippers[:, :3, 3], *(np.array(part) for part in zip(*_parts(poses), strict=True))]
    told = json.dumps([each.tolist() for each in views])
    command = [str(python), "-c", ASKED, *METHODS]
    answers = subprocess.run(command, input=told, capture_output=True, text=True, check=True).stdout.splitlines()
    found = {}
    for name, answer in zip(METHODS, answers, strict=True):
        turn, place = json.loads(answer)
        found[name.capitalize()] = transform(Rotation.from_matrix(turn), np.array(place))
    return found


def _parts(poses: list[Pose]) -> list[tuple[FloatArray, FloatArray]]:
    return [(pose.rotation, pose.x) for pose in poses]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--views", type=int, default=20)
    parser.add_argument("--opencv4", type=Path, help="A Python interpreter that has OpenCV 4.")
    tables_option(parser)
    given = parser.parse_args()
    robot = wrist_camera()
    errors: dict[str, list[tuple[float, float]]] = {}
    within: list[FloatArray] = []
    for seed in range(given.seeds):
        rng = np.random.default_rng([20261124, seed])
        T = transform(Rotation.from_rotvec(0.3 * rng.standard_normal(3)), 0.05 * rng.standard_normal(3))
        q, poses, grippers = views(robot, T, given.views, rng)
        own, inside = learnt(robot.chain, q, poses, T)
        within.append(inside)
        found = {"`RigidLearner`, all covariances": own}
        if given.opencv4 is not None:
            found |= of_opencv(given.opencv4, grippers, poses)
        for name, guess in found.items():
            off = Rotation.from_matrix(guess[:3, :3].T @ T[:3, :3]).magnitude()
            errors.setdefault(name, []).append((float(np.linalg.norm(guess[:3, 3] - T[:3, 3])), float(off)))
    print(
        f"{given.seeds} arms, {given.views} views each; T_flange_camera: RMS and largest error. This learner's 95 % "
        f"intervals hold {100.0 * np.mean(within):.0f} % of the numbers"
    )
    both = "{:.2g} ({:.2g})"
    columns = Column("method"), Column("place, RMS (largest)", "mm", both), Column("turn, RMS (largest)", "°", both)
    table = Table("hand_eye", columns)
    for name, each in errors.items():
        place, turn = 1e3 * np.array(each).T[0], np.degrees(np.array(each).T[1])
        table.add(name, *([np.sqrt(np.mean(part**2)), part.max()] for part in (place, turn)))
    table.save(given.tables)


if __name__ == "__main__":
    main()
