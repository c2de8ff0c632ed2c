"""Options of `bodyschema calibrate`: fixed parameters, expected errors on new poses and the ROS output."""

from __future__ import annotations

import functools
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from fitted_once import fitted_once as fitted_once
from scipy.spatial.transform import Rotation

from bodyschema.calibration.plausibility.verdict import Plausibility
from bodyschema.calibration.report import CalibrationReport
from bodyschema.calibration.rigid_chain import Calibration
from bodyschema.cli.main import command_line
from bodyschema.cli.terminal.calibration_view import sentences
from bodyschema.recordings.recording import Recording
from bodyschema.robot.description import RobotDescription
from bodyschema.robot.hand_eye import HandEye, write_launch_file
from kbmaps import ChainParameters, ChainTolerances
from kbmaps.robust import HALF_WIDTH_95

DESK_ARM = Path(__file__).parents[2] / "examples" / "desk_arm"
SIGMA_M = 5e-4
OFFSETS_DEG = np.array([0.0, 2.0, -1.5, 0.0])
ANYWHERE = ChainTolerances(tool=0.03, base_rotation=0.2, base_translation=0.2)
MADE = ChainTolerances(0.003, 0.001, tool=0.03, base_rotation=0.2, base_translation=0.2)


class Arm:
    """A desk arm whose camera and tool, and optionally links and joint offsets, deviate from nominal."""

    def __init__(self, made: ChainTolerances, offsets_deg: np.ndarray, seed: int) -> None:
        self.rng = np.random.default_rng(seed)
        self.robot = RobotDescription.load(DESK_ARM / "robot.toml")
        parameters = ChainParameters(self.robot.chain)
        self.change = parameters.standard_deviations(made) * self.rng.normal(size=parameters.size)
        self.change[parameters.zeros] = np.radians(offsets_deg)
        self.parameters = parameters
        self.recording = self.measured(120)

    def measured(self, poses: int) -> Recording:
        q = self.rng.uniform(self.robot.lower, self.robot.upper, (poses, 4))
        x = self.parameters.positions(self.change, q) + SIGMA_M * self.rng.normal(size=(poses, 3))
        return Recording(joints=self.robot.joints, q=q, x=x)

    def calibrated(self, trusted: str = "nothing") -> Calibration:
        return Calibration.of(self.robot, self.recording, sigma_m=None, zeros_rad=0.05, trusted=trusted)


@functools.cache
def arm(kind: str, seed: int = 0) -> Arm:
    made, offsets = {
        "as drawn": (ANYWHERE, np.zeros(4)),
        "with offsets": (ANYWHERE, OFFSETS_DEG),
        "made by hand": (MADE, OFFSETS_DEG),
    }[kind]
    return Arm(made, offsets, seed)


@functools.cache
def calibrated(kind: str, trusted: str = "nothing", seed: int = 0) -> Calibration:
    return arm(kind, seed).calibrated(trusted)


def report_on(calibration: Calibration, free: Calibration | None = None) -> CalibrationReport:
    return CalibrationReport.of(calibration, Plausibility(), "pairs.csv", frame="camera", free=free)


def test_a_trusted_urdf_tightens_the_hand_eye() -> None:
    free, trusted = (report_on(calibrated("as drawn", held)) for held in ("nothing", "urdf"))
    widths = [[figure.half_width for figure in report.camera_xyz_mm] for report in (free, trusted)]
    assert max(widths[1]) < 0.5 < max(widths[0])


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.soak) for seed in range(1, 5))])
def test_trusted_urdf_hand_eye_is_within_its_intervals(seed) -> None:
    planted = arm("as drawn", seed)
    report = report_on(calibrated("as drawn", "urdf", seed))
    true = np.linalg.inv(
        planted.parameters.chain(planted.change).fixed[0] @ np.linalg.inv(planted.robot.chain.fixed[0])
    )
    place = (planted.robot.camera.pose @ true)[:3, 3]
    off = np.abs([figure.learnt for figure in report.camera_xyz_mm] - 1e3 * place)
    assert (off < 2 * np.array([figure.half_width for figure in report.camera_xyz_mm])).all()


def test_a_trusted_urdf_has_no_offsets() -> None:
    assert [zero.zero for zero in report_on(calibrated("with offsets", "urdf")).zeros] == [0.0] * 4


def test_offsets_alone_are_found() -> None:
    zeros = report_on(calibrated("with offsets", "links")).zeros
    assert [zero.zero for zero in zeros] == pytest.approx(OFFSETS_DEG, abs=0.1)


def test_wrong_trusted_urdf_is_reported() -> None:
    told = sentences(report_on(calibrated("with offsets", "urdf"), calibrated("with offsets")))
    assert any("with nothing held, expect" in sentence for sentence in told)


def test_errors_of_trusted_urdf_are_not_called_noise() -> None:
    told = " ".join(sentences(report_on(calibrated("with offsets", "urdf"))))
    assert "Noise and errors of the URDF in a coordinate" in told
    assert len(re.findall(r"Mean distance to the samples: [\d.]+ mm\.", told)) == 1


def test_a_urdf_that_is_right_is_not_doubted() -> None:
    told = sentences(report_on(calibrated("as drawn", "urdf"), calibrated("as drawn")))
    assert not any("with nothing held" in sentence for sentence in told)


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.soak) for seed in range(1, 4))])
def test_expected_errors_are_those_of_new_poses(seed) -> None:
    planted = arm("made by hand", seed)
    calibration = calibrated("made by hand", seed=seed)
    fresh = planted.measured(1000)
    distances = np.linalg.norm(calibration.learner.predict(fresh.q) - fresh.x, axis=1)
    expected = calibration.expected
    assert expected is not None
    assert [expected.mean_m, expected.p95_m] == pytest.approx(
        [distances.mean(), np.quantile(distances, 0.95)], rel=0.25
    )


def test_hand_eye_is_the_same_in_every_form() -> None:
    report = report_on(calibrated("made by hand"))
    pose = report.hand_eye
    matrix = np.array(pose.matrix)
    rpy = Rotation.from_euler("xyz", [figure.learnt for figure in report.camera_rpy_deg], degrees=True)
    assert Rotation.from_quat(pose.quaternion_xyzw).as_matrix() == pytest.approx(matrix[:3, :3])
    assert rpy.as_matrix() == pytest.approx(matrix[:3, :3], abs=1e-9)
    assert 1e3 * matrix[:3, 3] == pytest.approx([figure.learnt for figure in report.camera_xyz_mm])


def test_hand_eye_covariance_has_the_intervals_in_it() -> None:
    report = report_on(calibrated("made by hand"))
    cov = np.array(report.hand_eye.covariance).reshape(6, 6)
    widths = [figure.half_width for figure in report.camera_xyz_mm]
    assert 1e3 * HALF_WIDTH_95 * np.sqrt(np.diag(cov)[:3]) == pytest.approx(widths)
    assert np.linalg.eigvalsh(cov)[0] > 0


def test_static_transform_line_publishes_the_pose() -> None:
    T = np.eye(4)
    T[:3] = np.column_stack([Rotation.from_euler("xyz", [0.3, -0.2, 2.9]).as_matrix(), [0.1, -0.25, 0.75]])
    line = HandEye.of("base_link", "camera", T).static_transform_publisher
    told = {name: float(value) for name, value in re.findall(r"--(q?[xyzw]) (\S+)", line)}
    assert [told[name] for name in "xyz"] == pytest.approx(T[:3, 3])
    turned = Rotation.from_quat([told[name] for name in ("qx", "qy", "qz", "qw")]).as_matrix()
    assert turned == pytest.approx(T[:3, :3], abs=1e-8)


def test_launch_file_has_the_same_arguments(tmp_path) -> None:
    pose = report_on(calibrated("made by hand")).hand_eye
    text = write_launch_file(pose, tmp_path).read_text()
    compile(text, "hand_eye.launch.py", "exec")
    assert (
        re.findall(r"'(\S+?)'", text.split("arguments = ")[1].split("]")[0])
        == pose.static_transform_publisher.split()[4:]
    )


def test_force_replaces_what_was_written_before(tmp_path) -> None:
    for name in ("robot.toml", "desk_arm.urdf"):
        shutil.copy(DESK_ARM / name, tmp_path)
    arm("made by hand").recording.write_csv(tmp_path / "pairs.csv")
    out = tmp_path / "out"
    words = ["calibrate", str(tmp_path / "pairs.csv"), "--out", str(out), "--force"]
    for _ in range(2):
        command_line("calibrate")(words, exit_on_error=False, result_action="return_value")
    assert (out / "robot.toml").exists()
