"""One camera and a tag on the tool: fixes, their claimed uncertainty, the arm learnt from them, and frame rates.

Run `python -m benchmarks.one_camera [--seeds N] [--pairs N]`. A desk arm of four joints is rendered as seen by one
camera of 640×480 pixels and f = 600 px: exact light of each pixel, a lens blur of 0.5 px, 2 grey levels of noise. The
tag of 50 mm on its tool is 0.5 to 0.7 m away and turned by up to 50° from the line of sight. The nominal model is wrong
by 1° an axis, 5 mm a point, 2° a joint offset and 20 mm at the tool. Encoders are exact, so the remaining error comes
from the corners.

The bound is that of Cramér and Rao for a chain with the nominal model's tolerances as its prior, from the corners'
claimed covariances: for positions alone, and for positions with orientations.
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

from benchmarks.tables import Column, Table, tables_option
from bodyschema.interfaces.camera import StereoCalibration
from bodyschema.interfaces.records import FloatArray, ImageArray, MarkerFix, StereoFrame
from bodyschema.robot.description import RobotDescription
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
NOISE = 2.0  # grey levels
WALL, WHITE, BLACK = 185.0, 193.0, 13.0
SQUARES, HALF_SHEET = 8, 0.5 + 1.0 / 8.0
ROWS_A_PIXEL, FINER = 24, 4
BLUR_PX = 0.5  # of the lens
PRINTED = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11).generateImageMarker(TAG.id, SQUARES) < 128
# The camera looks back at the arm from so far before its base.
PLACED = np.array([[0.0, 0.0, -1.0, 0.75], [1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.3], [0.0, 0.0, 0.0, 1.0]])
TEST_POSES = 300


class Arm:
    """A true arm, its nominal model, and the tag's orientation on the tool."""

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


def image(number: int, x: FloatArray, rotation: FloatArray) -> ImageArray:
    """Return the camera image of the tag at x (3,) [m] with rotation (3, 3), in front of a plain wall.

    Pixels are squares that collect light evenly. Along 24 lines within each row of pixels the grey level is integrated
    exactly between the computed places where it changes. The lens blur is applied at a quarter of the pixel size.
    """
    width, height = CAMERA.image_size_px
    u0, v0 = CAMERA.principal_point_px
    camera = np.array([[CAMERA.focal_px, 0.0, u0], [0.0, CAMERA.focal_px, v0], [0.0, 0.0, 1.0]])
    to_tag = np.asarray(np.linalg.inv(camera @ np.column_stack([SIDE_M * rotation[:, :2], x])), np.float64)
    corners = np.array([[c, r, 1.0] for c in (-HALF_SHEET, HALF_SHEET) for r in (-HALF_SHEET, HALF_SHEET)])
    corners = corners @ np.linalg.inv(to_tag).T
    low = np.floor((corners[:, :2] / corners[:, 2:]).min(axis=0) - 1.0).astype(int).clip(0)
    high = np.ceil((corners[:, :2] / corners[:, 2:]).max(axis=0) + 2.0).astype(int).clip(None, [width, height])
    v = low[1] - 0.5 + (np.arange((high[1] - low[1]) * ROWS_A_PIXEL) + 0.5) / ROWS_A_PIXEL
    lines = [-HALF_SHEET, *(np.arange(SQUARES + 1) / SQUARES - 0.5), HALF_SHEET]
    cuts = [to_tag[axis] - line * to_tag[2] for axis in (0, 1) for line in lines]
    changes = np.column_stack([-(cut[1] * v + cut[2]) / cut[0] for cut in cuts])
    borders = np.tile([low[0] - 0.5, high[0] - 0.5], (len(v), 1))
    changes = np.sort(np.column_stack([changes.clip(low[0] - 0.5, high[0] - 0.5), borders]), axis=1)
    between = 0.5 * (changes[:, 1:] + changes[:, :-1])
    light = np.cumsum(_levels(between, v, to_tag) * np.diff(changes, axis=1), axis=1)
    light = np.column_stack([np.zeros(len(v)), light])
    finer = np.arange(FINER * (high[0] - low[0]) + 1) / FINER + low[0] - 0.5
    rows = [np.diff(np.interp(finer, at, amount)) for at, amount in zip(changes, light, strict=True)]
    picture = np.full((height, width), WALL)
    blocks = np.reshape(rows, (FINER * (high[1] - low[1]), ROWS_A_PIXEL // FINER, -1))
    light = cv2.GaussianBlur(FINER * blocks.mean(axis=1), (0, 0), FINER * BLUR_PX, borderType=cv2.BORDER_REPLICATE)
    shown = light.reshape(high[1] - low[1], FINER, high[0] - low[0], FINER).mean(axis=(1, 3))
    picture[low[1] : high[1], low[0] : high[0]] = shown
    noise = NOISE * np.random.default_rng([7, number]).standard_normal((height, width, 3))
    return np.round(picture[..., None] + noise).clip(0.0, 255.0).astype(np.uint8)


def _levels(u: FloatArray, v: FloatArray, to_tag: FloatArray) -> FloatArray:
    """Return the grey levels at columns u (n, m) in lines v (n,) of the image."""
    place = np.stack([u, np.broadcast_to(v[:, None], u.shape), np.ones_like(u)], axis=-1) @ to_tag.T
    place = place[..., :2] / place[..., 2:]
    column = np.floor((place[..., 0] + 0.5) * SQUARES).astype(int)
    row = np.floor((0.5 - place[..., 1]) * SQUARES).astype(int)
    inside = (np.minimum(column, row) >= 0) & (np.maximum(column, row) < SQUARES)
    black = inside & PRINTED[row.clip(0, SQUARES - 1), column.clip(0, SQUARES - 1)]
    sheet = np.abs(place).max(axis=-1) < HALF_SHEET
    return np.where(black, BLACK, np.where(sheet, WHITE, WALL))


def measured(arm: Arm, q: FloatArray) -> tuple[list[MarkerFix], FloatArray, int]:
    """Return fixes of postures q (n, d) [rad], the postures they belong to, and the number of mirrored poses.

    Each posture is tracked from a single image.
    """
    fixes, kept, flipped = [], [], 0
    for number, pose in enumerate(arm.true.poses(q)):
        rotation = pose[:3, :3] @ arm.turn
        tracker = TagTracker(CAMERA, TagBody.single(TAG), TAG)
        seen = tracker.track(StereoFrame(float(number), image(number, pose[:3, 3], rotation), None))
        if isinstance(seen, MarkerFix):
            fixes.append(seen)
            kept.append(number)
            off = (Rotation.from_quat(seen.R) * Rotation.from_matrix(rotation).inv()).magnitude()
            flipped += bool(off > np.radians(10.0))
    return fixes, q[kept], flipped


def bound(arm: Arm, q: FloatArray, fixes: list[MarkerFix], test: FloatArray, *, oriented: bool) -> float:
    """Return the lower bound of the expected RMS distance [m] of any unbiased learner of these pairs."""
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
    rng = np.random.default_rng(seed)
    film = []
    for k in range(60):
        turn = Rotation.from_rotvec([np.pi - 0.5, 0.1 * np.sin(0.1 * k), 0.2]).as_matrix()
        x = np.array([0.1 * np.cos(0.05 * k), 0.08 * np.sin(0.05 * k), 0.6]) + 1e-3 * rng.standard_normal(3)
        film.append(StereoFrame(k / 30.0, image(k, x, turn), None))
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
    tables_option(parser)
    given = parser.parse_args()
    errors, claims, rows = [], [], []
    for seed in range(given.seeds):
        rng = np.random.default_rng([20261124, seed])
        arm = Arm(rng)
        fixes, q, flipped = measured(arm, arm.postures(given.pairs, rng))
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
    three = "{:.0f} {:.0f} {:.0f}"
    micrometres = [Column(what, "µm", three) for what in ("RMS error of a fix: across, down, depth", "claimed")]
    columns = Column("arms"), Column("fixes", "", "{:,}"), *micrometres, Column("within 1 sigma", "%", three)
    shown = Table("webcam_fixes", columns)
    shown.add(str(given.seeds), len(error), 1e6 * rms, 1e6 * said, share)
    shown.save(given.tables)
    together = np.sqrt(np.square(table).mean(axis=0))
    print(
        f"arm: {1e6 * together[0]:.0f} µm RMS, {together[0] / together[2]:.2f} times the bound (all directions alike "
        f"{together[1] / together[2]:.2f}); {together[0] / together[3]:.2f} times that with orientations"
    )
    followed, searched = frames_a_second(0)
    print(f"640×480, one core: {followed:.0f} frames/s followed, {searched:.0f} in whole images")


if __name__ == "__main__":
    main()
