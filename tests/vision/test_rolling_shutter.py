"""Moving tags in images whose rows are read one after the other."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from ball_renderer import SMALL, Look
from scipy.spatial.transform import Rotation
from tag_renderer import Sheet, photograph

from bodyschema.interfaces.camera import StereoCalibration
from bodyschema.interfaces.records import FloatArray, ImageArray, MarkerFix, MarkerMiss, StereoFrame
from bodyschema.vision.cameras.config import CamerasConfig, OneConfig
from bodyschema.vision.config import VisionConfig
from bodyschema.vision.tags.body import TagBody
from bodyschema.vision.tags.config import TagConfig
from bodyschema.vision.tags.image import TagImage
from bodyschema.vision.tags.tracker import TagTracker
from bodyschema.vision.tracked_camera import TrackedCamera
from bodyschema.vision.trackers import tracker_of

READOUT_S, FRAME_S = 0.02, 1.0 / 30.0
SPEED, SPIN = np.array([0.06, 0.08, 0.0]), np.radians([8.0, 4.0, 6.0])  # m/s, rad/s
START = np.array([0.02, 0.04, 0.4])
FACING = Rotation.from_euler("x", 25.0, degrees=True) * Rotation.from_matrix(np.diag([1.0, -1.0, -1.0]))
EYES = {"one": replace(SMALL, baseline_m=0.0), "two": SMALL}


def vision(readout_s: float | None) -> VisionConfig:
    cameras = CamerasConfig(one=OneConfig(device="webcam", image_size_px=(320, 240)), readout_s=readout_s)
    return VisionConfig(marker="tag", tag=TagConfig(side_m=0.03), cameras=cameras)


def pose(t: float) -> tuple[Rotation, FloatArray]:
    return Rotation.from_rotvec(SPIN * t) * FACING, START + SPEED * t


def film(eyes: str, moving: float = 1.0) -> list[StereoFrame]:
    """Return two frames of a tag that moves."""
    frames = []
    for k in range(2):
        rotation, x = pose(moving * k * FRAME_S)
        moved, turned = (tuple(moving * READOUT_S * each) for each in (SPEED, SPIN))
        sheet = Sheet(0, rotation.as_matrix(), x, 0.03, moved_m=moved, turned_rad=turned, exposed=0.25)
        look, rng = Look(wall=0.4, samples=6, noise_sd=1.0), np.random.default_rng(k)
        frame = photograph([sheet], SMALL, look, rng, t=k * FRAME_S)
        frames.append(frame if eyes == "two" else replace(frame, right=None))
    return frames


class Camera:
    """A camera that plays a film."""

    def __init__(self, calibration: StereoCalibration, frames: list[StereoFrame]) -> None:
        self.calibration, self._frames = calibration, frames

    def __enter__(self) -> Camera:
        return self

    def __exit__(self, *_: object) -> None: ...

    def read(self, timeout_s: float) -> StereoFrame | None:
        return self._frames.pop(0) if self._frames else None


def both_fixes(
    eyes: str, readout_s: float | None
) -> tuple[MarkerFix | MarkerMiss | None, MarkerFix | MarkerMiss | None]:
    """Return both fixes of the film."""
    config = vision(readout_s)
    camera = Camera(EYES[eyes], film(eyes))
    with TrackedCamera(camera, tracker_of(EYES[eyes], config), None, *config.readout) as source:
        return source.read(0.0), source.read(0.0)


def sigmas_off(fix: MarkerFix | MarkerMiss | None, true: tuple[Rotation, FloatArray] | None = None) -> FloatArray:
    """Return the errors of place and turn (6,) in sigmas of the fix: at the time it states, or from a true pose."""
    assert isinstance(fix, MarkerFix), fix
    assert fix.R is not None
    assert fix.cov_R is not None
    rotation, x = true or pose(fix.t)
    turn = (Rotation.from_quat(fix.R) * rotation.inv()).as_rotvec()
    return np.array([*(fix.x - x), *turn]) / np.sqrt([*np.diag(fix.cov), *np.diag(fix.cov_R)])


@pytest.mark.parametrize("eyes", EYES)
def test_moving_tag_pose_matches_truth_at_its_timestamp(eyes) -> None:
    assert np.abs(sigmas_off(both_fixes(eyes, READOUT_S)[1])).max() < 4.5


def test_wrong_global_shutter_assumption_biases_fix() -> None:
    assert np.abs(sigmas_off(both_fixes("one", 0.0)[1])).max() > 8.0


@pytest.mark.parametrize("eyes", EYES)
def test_moving_tag_allows_for_unknown_readout(eyes) -> None:
    fix = both_fixes(eyes, None)[1]
    assert isinstance(fix, MarkerFix)
    row = SMALL.project(fix.x)[1] / SMALL.image_size_px[1]
    assert np.abs(sigmas_off(fix, pose(fix.t + READOUT_S * (row - 0.5)))).max() < 3.0


def test_unknown_readout_is_up_to_a_frame() -> None:
    assert vision(None).readout == (0.0, pytest.approx(FRAME_S / 3.0**0.5))
    assert vision(0.0).readout == VisionConfig().readout == (0.0, 0.0)
    assert vision(READOUT_S).readout == (READOUT_S, 0.0)


class Projected:
    """A finder of one tag whose corners are projected at the times of their rows, with noise."""

    def __init__(self, calibration: StereoCalibration, readout_s: float, rng: np.random.Generator) -> None:
        self._calibration, self._readout_s, self._rng = calibration, readout_s, rng
        self._start, self._axis = pose(0.0)[1], rng.normal(size=3)
        self._velocity = (lambda v: v / np.linalg.norm(v))(rng.normal(size=3))
        self.t, self.shown, self._speed, self._eye = 0.0, 0, 0.0, 0

    def moving(self, speed: float) -> Projected:
        self._speed = speed
        return self

    def pose(self, t: float) -> tuple[Rotation, FloatArray]:
        return Rotation.from_rotvec(2.0 * self._speed * t * self._axis) * FACING, (
            self._start + self._speed * t * self._velocity
        )

    def suspicion(self, grey: ImageArray) -> None: ...

    def find(self, grey: ImageArray, region: object) -> dict[int, TagImage]:
        corners, late_s = TagBody.single(TAG).corners[0], np.zeros(4)
        seen = np.zeros((4, 4))
        for _ in range(4):  # until each corner is where it is when its row is read
            poses = [self.pose(self.t + late) for late in late_s]
            points = [R.as_matrix() @ c + x for c, (R, x) in zip(corners, poses, strict=True)]
            seen = np.array([self._calibration.project(p) for p in points])
            late_s = self._readout_s * (seen[:, 1] / self._calibration.image_size_px[1] - 0.5)
        px = seen[:, 2 * self._eye : 2 * self._eye + 2] + NOISE_PX * self._rng.normal(size=(4, 2))
        self._eye = (self._eye + 1) % len(self._calibration.eyes_m)
        return {self.shown: TagImage(self.shown, px, NOISE_PX**2 * np.eye(8))}


TAG, NOISE_PX = TagConfig(side_m=0.05), 0.03


def projected_fix(eyes: str, readout_s: float, speed: float, *told: float) -> tuple[MarkerFix, FloatArray]:
    """Return the second fix of a tag that moves, and its errors in sigmas."""
    finder = Projected(EYES[eyes], readout_s, np.random.default_rng(int(1e6 * readout_s))).moving(speed)
    tracker = TagTracker(EYES[eyes], TagBody.single(TAG), TAG, finder, *told)  # pyright: ignore[reportArgumentType]
    blank = np.zeros((*EYES[eyes].image_size_px[::-1], 3), np.uint8)
    fix = None
    for finder.t in (0.0, FRAME_S):
        fix = tracker.track(StereoFrame(finder.t, blank, blank if eyes == "two" else None))
    assert isinstance(fix, MarkerFix), fix
    row = EYES[eyes].project(fix.x)[1] / EYES[eyes].image_size_px[1]
    return fix, sigmas_off(fix, finder.pose(FRAME_S + readout_s * (row - 0.5)))


@pytest.mark.parametrize("speed", [0.05, 0.1])
@pytest.mark.parametrize("eyes", EYES)
def test_sigma_covers_every_readout_of_unknown(eyes, speed) -> None:
    off = np.array([projected_fix(eyes, s, speed, *vision(None).readout)[1] for s in np.linspace(0.0, FRAME_S, 60)])
    assert 0.6 < (np.abs(off) < 1.0).mean() < 0.95
    assert (np.abs(off) < 2.0).mean() > 0.9


def test_newly_seen_tag_has_readout_time_uncertainty() -> None:
    finder = Projected(EYES["one"], 0.0, np.random.default_rng(1))
    body = TagBody({k: TagBody.single(TAG).corners[0] + np.array([0.06 * k, 0.0, 0.0]) for k in (0, 1)})
    tracker = TagTracker(EYES["one"], body, TAG, finder, READOUT_S)  # pyright: ignore[reportArgumentType]
    blank, sigmas = np.zeros((240, 320, 3), np.uint8), []
    for finder.t, finder.shown in ((0.0, 0), (0.03, 0), (0.06, 1), (0.09, 1)):
        fix = tracker.track(StereoFrame(finder.t, blank, None))
        assert isinstance(fix, MarkerFix)
        sigmas.append(fix.t_sigma)
    assert sigmas == [READOUT_S, 0.0, READOUT_S, 0.0]


@pytest.mark.parametrize("eyes", EYES)
def test_unknown_readout_costs_nothing_at_rest(eyes) -> None:
    a, b = (projected_fix(eyes, 0.0, 0.0, *vision(s).readout)[0] for s in (0.0, None))
    assert np.abs(a.x - b.x).max() < 0.1 * np.sqrt(np.diag(a.cov)).max()
    assert np.sqrt(np.diag(b.cov)) == pytest.approx(np.sqrt(np.diag(a.cov)), rel=0.05)


def test_fix_timestamp_is_that_of_its_row() -> None:
    first, second = both_fixes("one", READOUT_S)
    assert isinstance(first, MarkerFix)
    assert isinstance(second, MarkerFix)
    row = SMALL.project(second.x)[1] / SMALL.image_size_px[1]
    assert second.t == pytest.approx(FRAME_S + READOUT_S * (row - 0.5), abs=1e-9)


def test_first_frame_is_unsure_of_its_time() -> None:
    first, second = both_fixes("one", READOUT_S)
    assert isinstance(first, MarkerFix)
    assert isinstance(second, MarkerFix)
    assert (first.t_sigma, second.t_sigma) == (READOUT_S, 0.0)


def test_unknown_readout_makes_the_rows_time_unsure() -> None:
    first, second = both_fixes("one", None)
    assert isinstance(first, MarkerFix)
    assert isinstance(second, MarkerFix)
    row, sigma_s = SMALL.project(second.x)[1] / SMALL.image_size_px[1], FRAME_S / 3.0**0.5
    assert second.t == FRAME_S
    assert second.t_sigma == pytest.approx(sigma_s * abs(row - 0.5))
    assert first.t_sigma >= sigma_s


def test_tag_at_rest_is_not_moved() -> None:
    still = film("one", moving=0.0)
    trackers = [tracker_of(EYES["one"], vision(s)) for s in (0.0, READOUT_S)]
    a, b = ([tracker.track(frame) for frame in still][1] for tracker in trackers)
    assert isinstance(a, MarkerFix)
    assert isinstance(b, MarkerFix)
    assert np.abs(a.x - b.x).max() < np.sqrt(np.diag(a.cov)).max()
