"""Moving tags in images whose rows are read one after the other."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from ball_renderer import SMALL, Look
from scipy.spatial.transform import Rotation
from tag_renderer import Sheet, photograph

from bodyschema.interfaces.camera import StereoCalibration
from bodyschema.interfaces.records import FloatArray, MarkerFix, MarkerMiss, StereoFrame
from bodyschema.vision.cameras.config import CamerasConfig, OneConfig
from bodyschema.vision.config import VisionConfig
from bodyschema.vision.tags.config import TagConfig
from bodyschema.vision.tracked_camera import TrackedCamera
from bodyschema.vision.trackers import tracker_of

READOUT_S, FRAME_S = 0.02, 1.0 / 30.0
SPEED, SPIN = np.array([0.06, 0.08, 0.0]), np.radians([8.0, 4.0, 6.0])  # m/s, rad/s
START = np.array([0.02, 0.04, 0.4])
FACING = Rotation.from_euler("x", 25.0, degrees=True) * Rotation.from_matrix(np.diag([1.0, -1.0, -1.0]))
EYES = {"one": replace(SMALL, baseline_m=0.0), "two": SMALL}


def vision(readout_s: float) -> VisionConfig:
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


def both_fixes(eyes: str, readout_s: float) -> tuple[MarkerFix | MarkerMiss | None, MarkerFix | MarkerMiss | None]:
    """Return both fixes of the film."""
    config = vision(readout_s)
    with TrackedCamera(Camera(EYES[eyes], film(eyes)), tracker_of(EYES[eyes], config), readout_s=readout_s) as source:
        return source.read(0.0), source.read(0.0)


def sigmas_off(fix: MarkerFix | MarkerMiss | None) -> FloatArray:
    """Return the errors of place and turn (6,) at the time that the fix states, in its sigmas."""
    assert isinstance(fix, MarkerFix), fix
    assert fix.R is not None
    assert fix.cov_R is not None
    rotation, x = pose(fix.t)
    turn = (Rotation.from_quat(fix.R) * rotation.inv()).as_rotvec()
    return np.array([*(fix.x - x), *turn]) / np.sqrt([*np.diag(fix.cov), *np.diag(fix.cov_R)])


@pytest.mark.parametrize("eyes", EYES)
def test_moving_tag_is_where_it_was_at_its_time(eyes) -> None:
    assert np.abs(sigmas_off(both_fixes(eyes, READOUT_S)[1])).max() < 4.5


def test_unknown_readout_is_felt_by_a_moving_tag() -> None:
    assert np.abs(sigmas_off(both_fixes("one", 0.0)[1])).max() > 8.0


def test_time_of_a_fix_is_that_of_its_row() -> None:
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


def test_tag_at_rest_is_not_moved() -> None:
    still = film("one", moving=0.0)
    trackers = [tracker_of(EYES["one"], vision(s)) for s in (0.0, READOUT_S)]
    a, b = ([tracker.track(frame) for frame in still][1] for tracker in trackers)
    assert isinstance(a, MarkerFix)
    assert isinstance(b, MarkerFix)
    assert np.abs(a.x - b.x).max() < np.sqrt(np.diag(a.cov)).max()
