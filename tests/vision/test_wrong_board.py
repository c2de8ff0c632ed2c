"""A calibration board whose squares are not of the stated size: from its images to what a diagnosis of the arm says."""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cache, cached_property

import cv2
import numpy as np
import pytest
from board_renderer import Photographer, Printed, Taken, TrueRig
from scenes import RADIUS_M, Ball, stage
from scipy.spatial.transform import Rotation
from shown_board import BOARD, SIZE, photographed
from tag_renderer import pattern
from walked import DESK_ARM

from bodyschema.diagnosis.diagnosis import diagnose
from bodyschema.diagnosis.report.conclusion import conclusion
from bodyschema.diagnosis.report.result import DiagnosisFile
from bodyschema.diagnosis.report.text import remedies
from bodyschema.effects import Simulation
from bodyschema.interfaces.records import FloatArray, ImageArray, MarkerFix, StereoFrame
from bodyschema.recordings.recording import Recording
from bodyschema.robot.description import RobotDescription
from bodyschema.vision.calibration.calibrate import CalibrationRequest, calibrate
from bodyschema.vision.calibration.gather import gathered
from bodyschema.vision.config import VisionConfig
from bodyschema.vision.rig.rectified import Rectification
from bodyschema.vision.tags.config import TagConfig
from bodyschema.vision.trackers import tracker_of

TOO_LARGE, SIDE_M, ROWS = 1.03, 0.05, 30
TAG = VisionConfig(marker="tag", tag=TagConfig(side_m=SIDE_M))


@dataclass(frozen=True)
class PrintedTag(Printed):
    """A tag in the place of the board."""

    columns: int = 1
    rows: int = 1
    square_m: float = SIDE_M

    @cached_property
    def cells(self) -> tuple[ImageArray, int]:
        return np.where(pattern(0), 0, 1).astype(np.uint8), 8


@cache
def calibrated(serials: tuple[str, ...]) -> tuple[TrueRig, Rectification]:
    """Return the true cameras, and their calibration from images of a board whose squares are stated too large."""
    truth, pairs, _ = photographed(count=12)
    shown = [pair if len(serials) > 1 else replace(pair, right=None) for pair in pairs]
    board = replace(BOARD, square_m=TOO_LARGE * BOARD.square_m)
    return truth, Rectification(
        calibrate(gathered(shown, board).views, board, CalibrationRequest(SIZE, serials, "2026")).rig
    )


def arm(rectification: Rectification, marker: str) -> RobotDescription:
    """Return the desk arm, seen by these cameras from near by."""
    seen = rectification.calibration
    eyes = f"baseline_m = {seen.baseline_m}" if seen.is_stereo else "eyes = 1"
    changes = {
        "focal_px = 600.0": f"focal_px = {seen.focal_px}",
        "principal_point_px = [319.5, 239.5]": f"principal_point_px = {list(seen.principal_point_px)}",
        "baseline_m = 0.20": eyes,
        "xyz = [1.1, 0.0, 0.3]": "xyz = [0.75, 0.0, 0.35]",
        'colour = "red"\nradius_m = 0.020': marker,
    }
    text = DESK_ARM.read_text()
    for old, new in changes.items():
        assert old in text
        text = text.replace(old, new)
    return RobotDescription.from_tables(tomllib.loads(text), text, DESK_ARM)


def postures(robot: RobotDescription) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Yield joint angles and the marker's position in the rectified frame."""
    rng, middle = np.random.default_rng(3), 0.5 * (robot.lower + robot.upper)
    while True:
        q = middle + rng.uniform(-1.0, 1.0, len(middle)) * np.array([0.9, 1.2, 1.4, 1.2])
        yield q, robot.chain.poses(q[None])[0, :3, 3]


def diagnosed(
    rectification: Rectification, marker: str, vision: VisionConfig, shown: Callable[[FloatArray], StereoFrame | None]
) -> tuple[DiagnosisFile, list[str]]:
    """Track the marker of an arm that follows its URDF, and return the diagnosis with its remedies."""
    robot = arm(rectification, marker)
    tracker, rows = tracker_of(rectification.calibration, vision), []
    for q, x in postures(robot):
        frame = shown(x)
        if frame is None:
            continue
        tracker.forget()
        fix = tracker.track(frame)
        assert isinstance(fix, MarkerFix), fix
        rows.append((q, fix.x, 0.5 * (fix.cov + fix.cov.T)))
        if len(rows) == ROWS:
            break
    q, x, cov = map(np.array, zip(*rows, strict=True))
    recording = Recording(robot.joints, q=q, x=x, t=np.arange(0.0, 4.0 * ROWS, 4.0), cov=cov, segment=np.arange(ROWS))
    file = conclusion(diagnose(recording, Simulation(robot)))
    none = np.zeros(len(robot.joints))
    return file, remedies(file, robot, none, none)


def in_view(*images: FloatArray) -> bool:
    return all(bool(((px > 50.0) & (px < np.array(SIZE) - 50.0)).all()) for px in images)


def test_overstated_squares_are_diagnosed_with_true_baseline_remedy() -> None:
    truth, rectification = calibrated(("A1", "B2"))
    real = replace(rectification.calibration, baseline_m=truth.baseline_m)

    def shown(x: FloatArray) -> StereoFrame | None:
        px = real.project(x)
        return stage(Ball(tuple(x), RADIUS_M), calibration=real) if in_view(px[:2], px[[2, 1]]) else None

    file, told = diagnosed(
        rectification, f'colour = "red"\nradius_m = {RADIUS_M}', VisionConfig(radius_m=RADIUS_M), shown
    )
    (cause,) = file.causes
    assert (file.verdict, cause.effect) == ("explained", "camera_scale")
    assert cause.parameters["scale_error"].value == pytest.approx(TOO_LARGE - 1.0, abs=3e-4)
    assert told[0].startswith("Measure the squares of the calibration board")
    assert float(told[0].split("baseline_m = ")[1].split()[0]) == pytest.approx(truth.baseline_m, rel=5e-4)


def photographed_tag(rectification: Rectification, truth: TrueRig) -> Callable[[FloatArray], StereoFrame | None]:
    """Return a function that photographs a tag at a place of the rectified frame, with all eyes that are calibrated."""
    rng = np.random.default_rng(5)
    photographer = Photographer(truth, PrintedTag(), Taken(), rng)
    maps = [rectification.maps(eye) for eye in range(len(rectification.eyes))]

    def shown(x: FloatArray) -> StereoFrame | None:
        own = rectification.R_rectified_left.T @ x
        if not in_view(truth.left.image(own[None]), truth.right.image((truth.R @ own + truth.t_m)[None])):
            return None
        axis = rng.normal(size=2)
        tilt = np.radians(25.0) * np.append(axis / np.linalg.norm(axis), 0.0)
        R = Rotation.from_rotvec(tilt).as_matrix()
        frame = photographer.pair(R, own - R @ np.array([0.5 * SIDE_M, 0.5 * SIDE_M, 0.0]))
        eyes = zip(frame.images, maps, strict=False)
        images = [np.asarray(cv2.remap(eye, *each, cv2.INTER_LINEAR), np.uint8) for eye, each in eyes]
        return StereoFrame(0.0, images[0], images[1] if len(images) > 1 else None)

    return shown


def test_one_eye_takes_no_length_from_the_board() -> None:
    truth, rectification = calibrated(("A1",))
    shown = photographed_tag(rectification, truth)
    file, _ = diagnosed(rectification, f'marker = "tag"\n[vision.tag]\nside_m = {SIDE_M}', TAG, shown)
    assert all(cause.effect != "camera_scale" for cause in file.causes)
    assert file.rms_mm.aligned < 1.5


def test_overstated_squares_make_stereo_tag_a_size_mismatch() -> None:
    truth, rectification = calibrated(("A1", "B2"))
    shown = photographed_tag(rectification, truth)
    tracker = tracker_of(rectification.calibration, TAG)
    answers = [
        tracker.track(frame) for x in np.mgrid[0:0.1:3j, 0:0.1:3j, 0.45:0.75:3j].reshape(3, -1).T if (frame := shown(x))
    ]
    assert len(answers) > 10
    assert {getattr(answer, "reason", None) for answer in answers} == {"size_mismatch"}
