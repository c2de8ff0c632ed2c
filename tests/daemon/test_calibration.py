"""What `bodyschema calibrate` finds and says, against planted robots."""

from __future__ import annotations

import dataclasses
import shutil
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
import pytest

from daemon.calibration import Calibration, CalibrationError
from daemon.calibration_report import CalibrationReport
from daemon.calibration_view import sentences
from daemon.cli import app
from daemon.config import Config
from daemon.recordings import of_robot
from interfaces.calibrated import CalibratedGeometry
from interfaces.calibrated_files import write_calibrated
from interfaces.errors import RecordingError
from interfaces.recording import Recording
from interfaces.robot import RobotDescription
from interfaces.rpy import rpy_of
from kbmaps import ChainParameters, ChainTolerances
from sim_backend import SimConfig, model_file
from sim_backend.config import ErrorConfig
from sim_backend.physics import Physics
from sim_backend.truth import TrueRobot

DESK_ARM = Path(__file__).parents[2] / "examples" / "desk_arm" / "robot.toml"
ZEROS_RAD = 0.05
SIGMA_M = 0.0005


@dataclass(frozen=True)
class Planted:
    """A desk arm that is not as drawn: its pairs, and the truth about it."""

    robot: RobotDescription
    parameters: ChainParameters
    change: np.ndarray
    recording: Recording

    def calibrated(self, **told) -> Calibration:
        return Calibration.of(self.robot, self.recording, **({"sigma_m": None, "zeros_rad": ZEROS_RAD} | told))


def planted(seed: int, *, pairs: int = 100, sigma: float = SIGMA_M, outliers: int = 0) -> Planted:
    """An arm made to 0.17° and 1 mm, its inner zeros off by 3°, camera and marker anywhere (1-sigma)."""
    rng = np.random.default_rng(seed)
    robot = RobotDescription.load(DESK_ARM)
    parameters = ChainParameters(robot.chain)
    made = ChainTolerances(0.003, 0.001, ZEROS_RAD, tool=0.03, base_rotation=0.5, base_translation=0.5)
    change = parameters.standard_deviations(made) * rng.normal(size=parameters.size)
    zeros = change[parameters.zeros]
    zeros[[0, -1]] = 0.0  # no motion tells them from a turn of camera and marker
    q = rng.uniform(robot.lower, robot.upper, (pairs, 4))
    x = parameters.positions(change, q) + sigma * rng.normal(size=(pairs, 3))
    x[:outliers] += 0.1
    return Planted(robot, parameters, change, Recording(joints=robot.joints, q=q, x=x))


# --- what is found


def report_on(arm: Planted) -> CalibrationReport:
    return CalibrationReport.of(arm.calibrated(), "pairs.csv")


def test_the_zeros_that_a_noise_free_recording_shows_are_found() -> None:
    arm = planted(1, sigma=0.0)
    zeros = [zero for zero in report_on(arm).zeros if zero.half_width is not None]
    assert [zero.joint for zero in zeros] == ["shoulder_pitch", "elbow_pitch"]
    off = np.abs([zero.zero for zero in zeros] - np.degrees(arm.change[arm.parameters.zeros][1:3]))
    assert (off < [zero.half_width for zero in zeros]).all()


def test_the_learnt_arm_is_the_true_one_within_the_noise() -> None:
    arm = planted(2)
    q = np.random.default_rng(0).uniform(arm.robot.lower, arm.robot.upper, (200, 4))
    off = np.linalg.norm(arm.calibrated().learner.predict(q) - arm.parameters.positions(arm.change, q), axis=1)
    assert off.mean() < SIGMA_M


def covered(seeds: range) -> float:
    """Share of the figures whose true values lie inside their intervals."""
    inside: list[bool] = []
    for seed in seeds:
        arm = planted(seed)
        found = arm.calibrated().figures
        off = found.values - figures_of(arm)
        told = np.append(np.ones(9, dtype=bool), found.shown)
        inside += (np.abs(off) < found.half_widths)[told].tolist()
    return float(np.mean(inside))


def figures_of(arm: Planted) -> np.ndarray:
    """What a calibration without errors would find."""
    zeros = arm.change[arm.parameters.zeros]
    pose = arm.parameters.base_pose(arm.change)
    chain = arm.parameters.chain(arm.change)
    geometry = CalibratedGeometry.of(arm.robot, chain, T_measured_nominal=pose, zeros=zeros)
    camera = geometry.T_parent_camera
    return np.concatenate([camera[:3, 3], rpy_of(camera[:3, :3]), geometry.marker_xyz, zeros])


def test_the_intervals_cover_what_was_planted() -> None:
    assert covered(range(8)) > 0.8  # the figures of one arm go together


@pytest.mark.soak
def test_the_95_percent_intervals_cover_95_percent() -> None:
    assert 0.93 < covered(range(200)) < 0.97


def test_outliers_are_counted_and_left_out() -> None:
    assert report_on(planted(3, outliers=4)).outliers == 4


def test_too_few_pairs_are_told() -> None:
    with pytest.raises(CalibrationError, match="7 pairs are too few to calibrate 4 joints; record at least 8"):
        planted(1, pairs=7).calibrated()


def test_a_marker_that_never_moved_is_told() -> None:
    arm = planted(1)
    still = Recording(joints=arm.robot.joints, q=arm.recording.q, x=np.ones((100, 3)))
    with pytest.raises(CalibrationError, match="no chain can be fitted to the recording: the measured positions x lie"):
        Calibration.of(arm.robot, still, sigma_m=None, zeros_rad=ZEROS_RAD)


# --- what is said


def said(arm: Planted, **changed) -> str:
    return "\n".join(sentences(msgspec.structs.replace(report_on(arm), **changed)))


def test_zeros_that_nothing_shows_are_said_to_be_left_as_drawn() -> None:
    assert "Left as drawn: base_yaw, wrist_roll. Nothing that was measured tells their zeros" in said(planted(1))


def test_a_joint_that_hardly_moved_is_named() -> None:
    arm = planted(1)
    q = arm.recording.q.copy()
    q[:, 2] *= 0.01
    recording = Recording(joints=arm.robot.joints, q=q, x=arm.parameters.positions(arm.change, q))
    assert "Hardly moved: elbow_pitch." in said(dataclasses.replace(arm, recording=recording))


def test_noise_that_no_camera_has_is_questioned() -> None:
    assert "Are positions in metres, angles in radians" in said(planted(1), noise_mm=80.0)


def test_residuals_that_the_told_noise_does_not_explain_are_said() -> None:
    assert "residuals are 3.0 times what the noise explains" in said(planted(1), misfit=3.0)


# --- the command


@pytest.fixture
def pairs_file(tmp_path) -> Path:
    shutil.copytree(DESK_ARM.parent, tmp_path / "arm")
    file = tmp_path / "arm" / "pairs.csv"
    planted(1).recording.write_csv(file)
    return file


def called(*arguments: object) -> None:
    app(["calibrate", *map(str, arguments)], exit_on_error=False, result_action="return_value")


def test_the_table_fits_a_terminal_of_80_columns(pairs_file, capsys, monkeypatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    called(pairs_file)
    lines = capsys.readouterr().out.splitlines()
    assert max(len(line.rstrip()) for line in lines) <= 80
    assert next(line.split()[:2] for line in lines if "[°]" in line) == ["roll", "[°]"]


def test_the_written_robot_is_the_learnt_one(pairs_file, tmp_path, capsys) -> None:
    called(pairs_file, "--out", tmp_path / "calibrated")
    assert "robot.toml written. Next: `bodyschema run --robot" in capsys.readouterr().out.replace("\n", " ")
    written = Config.load(tmp_path / "calibrated" / "robot.toml", {}).robot
    robot = RobotDescription.load(DESK_ARM)
    read = Recording.read(pairs_file, robot.joints)
    learnt = Calibration.of(robot, read, sigma_m=None, zeros_rad=np.radians(3.0)).learner.chain
    np.testing.assert_allclose(written.chain.positions(read.q), learnt.positions(read.q), rtol=0, atol=1e-9)


def test_json_has_every_figure(pairs_file, capsys) -> None:
    called(pairs_file, "--json")
    found = msgspec.json.decode(capsys.readouterr().out, type=CalibrationReport)
    assert (found.pairs, len(found.camera_rpy_deg), len(found.zeros)) == (100, 3, 4)


def test_a_store_of_other_joints_is_refused() -> None:
    recording = planted(1).recording
    with pytest.raises(
        RecordingError, match=r"pairs.sqlite: the pairs are of other joints: base_yaw, .*this one has a"
    ):
        of_robot(recording, ("a", "b"), Path("pairs.sqlite"))


def test_export_says_who_writes_a_urdf(pairs_file, tmp_path) -> None:
    with pytest.raises(RecordingError, match=r"a URDF is of a robot, not of pairs. `bodyschema calibrate` learns one"):
        app(["export", str(pairs_file), str(tmp_path / "arm.urdf")], exit_on_error=False)


def test_the_simulation_takes_a_calibrated_robot(tmp_path) -> None:
    robot = RobotDescription.load(model_file("upper_body"))
    q = np.random.default_rng(5).uniform(robot.lower, robot.upper, (60, len(robot.joints)))
    x = TrueRobot.draw(robot, SimConfig()).chain(np.array(robot.robot.marker_xyz)).positions(q)
    found = Calibration.of(robot, Recording(joints=robot.joints, q=q, x=x), sigma_m=1e-4, zeros_rad=ZEROS_RAD)
    calibrated = RobotDescription.load(write_calibrated(robot, found.figures.geometry, tmp_path, "From a test"))
    exact = ErrorConfig(
        joint_offset_rad=0, link_length_m=0, link_axis_rad=0, camera_position_m=0, camera_rotation_rad=0, tool_m=0
    )
    config = SimConfig(errors=exact)
    assert calibrated.calibration is not None
    with Physics(TrueRobot.draw(calibrated, config), calibrated.calibration, config) as physics:
        physics.step()
        scene = physics.scene()
    seen = (np.linalg.inv(scene.T_world_camera) @ np.append(scene.x_world, 1.0))[:3]
    np.testing.assert_allclose(seen, found.learner.predict(scene.angles), rtol=0, atol=1e-6)
