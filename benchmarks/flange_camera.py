"""A calibrated camera on the flange and a tag in the world: T_flange_camera, and its uncertainty from `calibrate`.

Run `python -m benchmarks.flange_camera [--arms N] [--pairs N]`. For each arm the camera is calibrated from 20 rendered
views of a board, and sees tags 0.25 to 0.8 m away, rendered as in `benchmarks.one_camera`. The tag's side is off by
0.1 mm (1-sigma), joint zeros by 3°, encoders have 12 bits, links are as in the URDF. Joint zeros that cannot be
distinguished from the camera's pose belong to the truth: the last one rotates the camera. So does a rotation of the
calibration's frame.
"""

from __future__ import annotations

import argparse
import os
import sys
from dataclasses import dataclass
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "vision"))

from board_renderer import Photographer, Printed, Taken, TrueLens, TrueRig, poses

from benchmarks import one_camera
from benchmarks.calibrated_camera import LENS, SIDE_SIGMA_M, frame_turn
from benchmarks.hand_eye import transform, wrist_camera
from benchmarks.one_camera import BORDER_PX, CAMERA, MOST_OBLIQUE, ROBOT, SIDE_M, TAG, image
from benchmarks.tables import Column, Table, tables_option
from bodyschema.calibration.plausibility.check import plausibility
from bodyschema.calibration.report import CalibrationReport
from bodyschema.calibration.rigid_chain import Calibration
from bodyschema.interfaces.records import FloatArray, MarkerFix, StereoFrame
from bodyschema.recordings.recording import Recording
from bodyschema.robot.description import RobotDescription
from bodyschema.vision.board import Board, BoardDetector, Corners
from bodyschema.vision.calibration.calibrate import CalibrationRequest, calibrate
from bodyschema.vision.calibration.view import View
from bodyschema.vision.rig.common_error import CommonError
from bodyschema.vision.rig.rectified import Rectification
from bodyschema.vision.rig.stereo_rig import Rig
from bodyschema.vision.tags.body import TagBody
from bodyschema.vision.tags.tracker import TagTracker

VIEWS, NEAREST_M, FARTHEST_M = 20, 0.25, 0.8
ZEROS_RAD, TICK_RAD = np.radians(3.0), 2.0 * np.pi / 4096
PLACE_M, SHIFT_M, TURN_RAD = np.array([0.03, -0.02, 0.05]), 0.01, np.radians(6.0)  # of the camera on the flange
T_BASE_TAG = transform(Rotation.from_euler("xyz", [5.0, -4.0, 20.0], degrees=True), np.array([0.35, 0.02, -0.33]))
NAMES = ("x [mm]", "y [mm]", "z [mm]", "roll [°]", "pitch [°]", "yaw [°]")


def calibrated(rng: np.random.Generator) -> Rig:
    """Return the camera's calibration from rendered views of a board."""
    lens = TrueLens(LENS.focal_px, LENS.principal_point_px, LENS.distortion)
    rig = TrueRig(lens, lens, np.eye(3), np.array([-0.12, 0.0, 0.0]), CAMERA.image_size_px)
    photographer, detector = Photographer(rig, Printed(), Taken(), rng), BoardDetector(Board())
    found = [detector.find(photographer.left(*pose)) for pose in poses(rng, rig, Printed(), VIEWS)]
    views = [View(str(k), corners, None) for k, corners in enumerate(found) if isinstance(corners, Corners)]
    return calibrate(views, Board(), CalibrationRequest(CAMERA.image_size_px, ("",), "", model="pinhole")).rig


@dataclass(frozen=True)
class Wrist:
    """A camera on the gripper of a desk arm. Angles are in the order of the arm's joints, from the base on."""

    T_gripper_camera: FloatArray
    zeros: FloatArray

    def gripper(self, q: FloatArray) -> FloatArray:
        """Return the gripper's poses (n, 4, 4) in the base at true angles (n, d) [rad]."""
        return RobotDescription.load(ROBOT).with_placement(np.eye(4), np.zeros(3)).chain.poses(q)

    def tag(self, q: FloatArray) -> FloatArray:
        """Return the tag's poses (n, 4, 4) in the camera at measured angles (n, d) [rad]."""
        return np.linalg.inv(self.gripper(q + self.zeros) @ self.T_gripper_camera) @ T_BASE_TAG

    def readings(self, count: int, rng: np.random.Generator) -> FloatArray:
        """Return measured angles (count, d) [rad] of poses in which the camera sees the tag."""
        robot = RobotDescription.load(ROBOT)
        q = rng.uniform(robot.lower, robot.upper, (400 * count, len(robot.joints)))
        T = self.tag(q)
        x, distance = T[:, :3, 3], np.linalg.norm(T[:, :3, 3], axis=1)
        px = CAMERA.project(np.column_stack([x[:, :2], np.maximum(x[:, 2], 0.1)]))[:, :2]
        seen = (
            (x[:, 2] > NEAREST_M)
            & (x[:, 2] < FARTHEST_M)
            & (-(T[:, :3, 2] * x).sum(1) > distance * np.cos(MOST_OBLIQUE))
        )
        seen &= ((px > BORDER_PX) & (px < np.array(CAMERA.image_size_px) - BORDER_PX)).all(axis=1)
        return q[seen][:count]

    def truth(self, rig: Rig) -> FloatArray:
        """Return x, y, z [mm] and roll, pitch, yaw [°] of the camera, given the last joint's nominal zero."""
        last = np.zeros((2, len(self.zeros)))
        last[1, -1] = self.zeros[-1]
        before, after = self.gripper(last)
        T = np.linalg.inv(before) @ after @ self.T_gripper_camera
        return figures(T[:3, 3], T[:3, :3] @ frame_turn(rig).T)


def figures(x: FloatArray, rotation: FloatArray) -> FloatArray:
    """Return x, y, z [mm] and roll, pitch, yaw [°]."""
    return np.concatenate([1e3 * x, Rotation.from_matrix(rotation).as_euler("xyz", degrees=True)])


def recorded(wrist: Wrist, rig: Rig, count: int, rng: np.random.Generator) -> Recording:
    """Return the pairs of rendered images."""
    rectification, q = Rectification(rig), wrist.readings(count, rng)
    maps, tracker = rectification.maps(0), TagTracker(rectification.calibration, TagBody.single(TAG), TAG)
    one_camera.SIDE_M = SIDE_M + SIDE_SIGMA_M * rng.standard_normal()  # the tag's printed side
    first, kept, fixes = int(rng.integers(1 << 40)), [], []
    for k, T in enumerate(wrist.tag(q)):
        tracker.forget()
        seen = cv2.remap(image(first + k, T[:3, 3], T[:3, :3]), *maps, cv2.INTER_LINEAR)
        fix = tracker.track(StereoFrame(float(k), np.asarray(seen, np.uint8), None))
        if isinstance(fix, MarkerFix):
            kept.append(TICK_RAD * np.round(q[k, ::-1] / TICK_RAD))
            fixes.append(fix)
    return Recording(
        joints=wrist_camera().joints,
        q=np.array(kept),
        x=np.array([fix.x for fix in fixes]),
        t=np.array([fix.t for fix in fixes]),
        cov=np.array([0.5 * (fix.cov + fix.cov.T) for fix in fixes]),
        orientation=np.array([fix.R for fix in fixes]),
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--arms", type=int, default=24)
    parser.add_argument("--pairs", type=int, default=60)
    tables_option(parser)
    given = parser.parse_args()
    robot, off, claimed = wrist_camera(), [], []
    for seed in range(given.arms):
        rng = np.random.default_rng([20261127, seed])
        turn = Rotation.from_rotvec(TURN_RAD * rng.standard_normal(3))
        placed = transform(turn, PLACE_M + SHIFT_M * rng.standard_normal(3))
        wrist, rig = Wrist(placed, ZEROS_RAD * rng.standard_normal(len(robot.joints))), calibrated(rng)
        recording = recorded(wrist, rig, given.pairs, rng)
        common = CommonError(rig, SIDE_SIGMA_M / SIDE_M).errors
        found = Calibration.of(robot, recording, sigma_m=None, zeros_rad=float(ZEROS_RAD), common=common)
        plausible = plausibility(robot, recording.q, recording.x, sigma_m=None, orientation=recording.orientation)
        report = CalibrationReport.of(found, plausible, "", 1, "", None)
        learnt = [*report.camera_xyz_mm, *report.camera_rpy_deg]
        off.append([figure.learnt for figure in learnt] - wrist.truth(rig))
        claimed.append([figure.half_width / 1.96 for figure in learnt])
    error, sigma = np.array(off), np.array(claimed)
    lengths = [Column(what, "", "{:.3f}") for what in ("RMS error", "claimed")]
    shares = [Column(f"within {number} sigma", "", "{} of {}") for number in (1, 2)]
    table = Table("flange_camera", [Column("T_flange_camera"), *lengths, *shares])
    for k, name in enumerate(NAMES):
        rms, said = np.sqrt(np.square(error[:, k]).mean()), np.sqrt(np.square(sigma[:, k]).mean())
        within = [int((np.abs(error[:, k]) < wide * sigma[:, k]).sum()) for wide in (1.0, 2.0)]
        table.add(name, rms, said, *([count, given.arms] for count in within))
    table.save(given.tables)


if __name__ == "__main__":
    main()
