"""One camera and a tag on the tool: fixes, their claimed uncertainty, the arm learnt from them, and frame rates.

Run `python -m benchmarks.one_camera [--seeds N] [--pairs N]`. A desk arm of four joints is rendered as one camera of
640×480 pixels and f = 600 px sees it, with 2 grey levels of noise; the tag of 50 mm on its tool is 0.5 to 0.7 m away
and turned by up to 50° from the line of sight. The nominal model is wrong by 1° an axis, 5 mm a point, 2° a joint
offset and 20 mm at the tool. Encoders are exact, so the remaining error comes from the corners.

The bound is that of Cramér and Rao for a chain with the nominal model's tolerances as its prior, from the corners'
claimed covariances: positions alone, and with the orientations too.
"""

from __future__ import annotations

import argparse
import os
import time
from dataclasses import replace
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from bodyschema.interfaces.camera import StereoCalibration
from bodyschema.interfaces.records import FloatArray, ImageArray, MarkerFix, StereoFrame
from bodyschema.robot.description import RobotDescription
from bodyschema.sim_backend.config import CameraConfig, SimTag
from bodyschema.sim_backend.rendering.eye import StereoEyes
from bodyschema.sim_backend.rendering.raster import EmptyWorld
from bodyschema.vision.tags.body import TagBody
from bodyschema.vision.tags.config import TagConfig
from bodyschema.vision.tags.tracker import TagTracker
from kbmaps import ChainParameters, ChainTolerances, RigidChain, RigidLearner

ROBOT = Path(__file__).parent.parent / "examples" / "desk_arm" / "robot.toml"
CAMERA = StereoCalibration(600.0, (319.5, 239.5), 0.0, (640, 480), pixel_sigma=0.0)
SIDE_M, NEAREST_M, FARTHEST_M = 0.05, 0.5, 0.7
MOST_OBLIQUE, BORDER_PX = np.radians(50.0), 40.0
DRAWN = ChainTolerances(
    axes=np.radians(1.0),
    points=0.005,
    zeros=np.radians(2.0),
    tool=0.02,
    base_rotation=np.radians(2.0),
    base_translation=0.02,
)
TAG = TagConfig(side_m=SIDE_M)
SHEET = SimTag(id=TAG.id, xyz=(0.0, 0.0, 0.0), rpy=(0.0, 0.0, 0.0), side_m=SIDE_M)
LOOK = CameraConfig(tags=(SHEET,), tag_dictionary=cv2.aruco.DICT_APRILTAG_36h11, clutter=0, supersampling=8, noise=0)
# Grey levels of noise, and paintings that are averaged before it comes: one alone has more noise of its own at edges.
NOISE, PAINTINGS = 2.0, 12
# The camera looks back at the arm from so far before its base.
PLACED = np.array([[0.0, 0.0, -1.0, 0.75], [1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.3], [0.0, 0.0, 0.0, 1.0]])
TEST_POSES = 300


class Arm:
    """A true arm, of which the drawing is `nominal`, and how the tag is turned on its tool."""

    def __init__(self, rng: np.random.Generator) -> None:
        robot = RobotDescription.load(ROBOT)
        self.lower, self.upper = robot.lower, robot.upper
        self.nominal = robot.with_placement(PLACED, np.array(robot.robot.marker_xyz)).chain
        parameters = ChainParameters(self.nominal)
        change = parameters.standard_deviations(DRAWN) * rng.standard_normal(parameters.size)
        self.true: RigidChain = parameters.chain(change)
        turns = Rotation.create_group("O").as_matrix()
        q = rng.uniform(self.lower, self.upper, (2000, len(self.lower)))
        self.turn = max(turns, key=lambda turn: int(self._shown(q, turn).sum()))

    def _shown(self, q: FloatArray, turn: FloatArray) -> np.ndarray:
        T = self.true.poses(q)
        x, facing = T[:, :3, 3], (T[:, :3, :3] @ turn)[:, :, 2]
        distance = np.linalg.norm(x, axis=1)
        seen = (x[:, 2] > 0.3) & (distance > NEAREST_M) & (distance < FARTHEST_M)
        px = CAMERA.project(np.column_stack([x[:, :2], np.maximum(x[:, 2], 0.3)]))[:, :2]
        seen &= ((px > BORDER_PX) & (px < np.array(CAMERA.image_size_px) - BORDER_PX)).all(axis=1)
        return seen & (-(facing * x).sum(axis=1) / distance > np.cos(MOST_OBLIQUE))

    def postures(self, count: int, rng: np.random.Generator) -> FloatArray:
        """Return postures (count, d) in which the camera sees the tag."""
        found = np.zeros((0, len(self.lower)))
        while len(found) < count:
            q = rng.uniform(self.lower, self.upper, (4000, len(self.lower)))
            found = np.concatenate([found, q[self._shown(q, self.turn)]])
        return found[:count]


def image(eyes: StereoEyes, number: int, x: FloatArray, rotation: FloatArray) -> ImageArray:
    """Render the camera image of the tag at x (3,) [m] with rotation (3, 3)."""
    width, height = CAMERA.image_size_px
    total = np.zeros((height, width, 3))
    for again in range(PAINTINGS):
        picture = np.full((height, width, 3), 90, np.uint8)
        eyes.paint(PAINTINGS * number + again, np.eye(4), x[None], rotation, (picture,))
        total += picture
    noise = NOISE * np.random.default_rng([7, number]).standard_normal(total.shape)
    return np.round(total / PAINTINGS + noise).clip(0.0, 255.0).astype(np.uint8)


def measured(arm: Arm, q: FloatArray, seed: int) -> tuple[list[MarkerFix], FloatArray, int]:
    """Return fixes of postures q (n, d) [rad], the postures they belong to, and the number of mirrored poses.

    Each posture is tracked from a single image.
    """
    eyes, fixes, kept, flipped = StereoEyes(EmptyWorld(), CAMERA, LOOK, seed), [], [], 0
    for number, pose in enumerate(arm.true.poses(q)):
        rotation = pose[:3, :3] @ arm.turn
        tracker = TagTracker(CAMERA, TagBody.single(TAG), TAG)
        seen = tracker.track(StereoFrame(float(number), image(eyes, number, pose[:3, 3], rotation), None))
        if isinstance(seen, MarkerFix):
            fixes.append(seen)
            kept.append(number)
            off = (Rotation.from_quat(seen.R) * Rotation.from_matrix(rotation).inv()).magnitude()
            flipped += bool(off > np.radians(10.0))
    return fixes, q[kept], flipped


def bound(arm: Arm, q: FloatArray, fixes: list[MarkerFix], test: FloatArray, *, oriented: bool) -> float:
    """Return the RMS distance [m] that no unbiased learner of these pairs falls below on average."""
    parameters = ChainParameters(arm.true)
    spread = parameters.standard_deviations(DRAWN)
    columns = np.flatnonzero(spread > 0.0)
    zero = np.zeros(parameters.size)
    information = np.zeros((len(columns) + 3 * oriented, len(columns) + 3 * oriented))
    information[: len(columns), : len(columns)] += np.diag(spread[columns] ** -2.0)
    _, J = parameters.linearised(zero, q)
    turns, by_turn = parameters.turned(zero, q)
    for row, fix in enumerate(fixes):
        whole = J[row][:, columns]
        precision = np.linalg.inv(fix.cov)
        if oriented:
            assert fix.cov_R is not None
            whole = np.block([[whole, np.zeros((3, 3))], [by_turn[row][:, columns], turns[row]]])
            precision = np.block([[precision, np.zeros((3, 3))], [np.zeros((3, 3)), np.linalg.inv(fix.cov_R)]])
        information += whole.T @ precision @ whole
    cov = np.linalg.inv(information)[: len(columns), : len(columns)]
    _, there = parameters.linearised(zero, test)
    there = there[:, :, columns]
    return float(np.sqrt(np.einsum("nij,jk,nik->n", there, cov, there).mean()))


def frames_a_second(seed: int) -> tuple[float, float]:
    """Return the frame rates [1/s] on one core: tracking through a film, and searching whole images."""
    eyes, rng = StereoEyes(EmptyWorld(), CAMERA, LOOK, seed), np.random.default_rng(seed)
    film = []
    for k in range(60):
        turn = Rotation.from_rotvec([np.pi - 0.5, 0.1 * np.sin(0.1 * k), 0.2]).as_matrix()
        x = np.array([0.1 * np.cos(0.05 * k), 0.08 * np.sin(0.05 * k), 0.6]) + 1e-3 * rng.standard_normal(3)
        film.append(StereoFrame(k / 30.0, image(eyes, k, x, turn), None))
    speeds = []
    for forgets in (False, True):
        tracker = TagTracker(CAMERA, TagBody.single(TAG), TAG)
        tracker.track(replace(film[0], t=-0.03))
        began = time.process_time()
        for frame in film:
            if forgets:
                tracker.forget()
            tracker.track(frame)
        speeds.append(len(film) / (time.process_time() - began))
    return speeds[0], speeds[1]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--pairs", type=int, default=300)
    given = parser.parse_args()
    errors, claims, rows = [], [], []
    for seed in range(given.seeds):
        rng = np.random.default_rng([20261124, seed])
        arm = Arm(rng)
        fixes, q, flipped = measured(arm, arm.postures(given.pairs, rng), seed)
        x, cov = np.array([fix.x for fix in fixes]), np.array([fix.cov for fix in fixes])
        errors.append(x - arm.true.positions(q))
        claims.append(np.sqrt(np.diagonal(cov, axis1=1, axis2=2)))
        test = arm.postures(TEST_POSES, rng)
        truth = arm.true.positions(test)
        learners = [RigidLearner(arm.nominal, DRAWN) for _ in range(2)]
        learners[0].learn(q, x, cov=cov)
        learners[1].learn(q, x)
        off = [float(np.sqrt(np.square(each.predict(test) - truth).sum(axis=1).mean())) for each in learners]
        estimate = learners[0].estimate(test)
        inside = 100.0 * float((np.abs(estimate.x - truth) < estimate.sigma).mean())
        least = [bound(arm, q, fixes, test, oriented=oriented) for oriented in (False, True)]
        rows.append([*off, *least])
        print(
            f"seed {seed}: {len(fixes)} fixes of {given.pairs}, {flipped} flipped; arm off by {1e6 * off[0]:.0f} µm "
            f"RMS (all directions alike {1e6 * off[1]:.0f}), bound {1e6 * least[0]:.0f} (with orientations "
            f"{1e6 * least[1]:.0f}); {inside:.0f} % within 1 sigma"
        )
    error, claim, table = np.concatenate(errors), np.concatenate(claims), np.array(rows)
    rms, said = np.sqrt(np.square(error).mean(axis=0)), np.sqrt(np.square(claim).mean(axis=0))
    share = 100.0 * (np.abs(error) < claim).mean(axis=0)
    print(f"fixes: RMS x y z {1e6 * rms} µm, claimed {1e6 * said} µm, within 1 sigma {share} %, n = {len(error)}")
    together = np.sqrt(np.square(table).mean(axis=0))
    print(
        f"arm: {1e6 * together[0]:.0f} µm RMS, {together[0] / together[2]:.2f} times the bound (all directions alike "
        f"{together[1] / together[2]:.2f}); {together[0] / together[3]:.2f} times that with orientations"
    )
    followed, searched = frames_a_second(0)
    print(f"640×480, one core: {followed:.0f} frames/s followed, {searched:.0f} in whole images")


if __name__ == "__main__":
    main()
