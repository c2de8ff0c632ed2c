"""Results and messages of `bodyschema calibrate` for planted robots."""

from __future__ import annotations

import dataclasses
import functools
import shutil
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
import pytest
from fitted_once import fitted_once as fitted_once

from bodyschema.calibration.plausibility.verdict import Plausibility
from bodyschema.calibration.report import CalibrationReport
from bodyschema.calibration.rigid_chain import Calibration, CalibrationError
from bodyschema.cli.commands.options import SourceOptions
from bodyschema.cli.main import app
from bodyschema.cli.recordings.foreign import seen_elsewhere
from bodyschema.cli.terminal.calibration_view import sentences
from bodyschema.daemon.config import Config
from bodyschema.daemon.learner.checkpoint import write_checkpoint
from bodyschema.daemon.sampler.devices import session_of
from bodyschema.interfaces.clock import SystemClock
from bodyschema.interfaces.errors import RecordingError
from bodyschema.interfaces.records import MarkerFix
from bodyschema.learning.nominal import NominalModel
from bodyschema.learning.online_learner import OnlineLearner
from bodyschema.learning.solvers.solver import DirectSolver
from bodyschema.recordings.files import of_robot
from bodyschema.recordings.recording import Recording
from bodyschema.recordings.store.store import PairStore
from bodyschema.robot.calibrated import CalibratedGeometry
from bodyschema.robot.calibrated_files import write_calibrated
from bodyschema.robot.description import RobotDescription
from bodyschema.robot.rpy import rpy_of
from bodyschema.sim_backend import SimConfig, model_file
from bodyschema.sim_backend.config import ErrorConfig
from bodyschema.sim_backend.physics import Physics
from bodyschema.sim_backend.truth import TrueRobot
from bodyschema.vision.rig.lens import Lens
from bodyschema.vision.rig.rig_file import write_rig
from bodyschema.vision.rig.stereo_rig import CalibrationProvenance, StereoRig
from kbmaps import ChainParameters, ChainTolerances

DESK_ARM = Path(__file__).parents[2] / "examples" / "desk_arm" / "robot.toml"
ZEROS_RAD = 0.05
SIGMA_M = 0.0005


@dataclass(frozen=True, eq=False)
class Planted:
    """A desk arm that deviates from nominal: its pairs and the ground truth."""

    robot: RobotDescription
    parameters: ChainParameters
    change: np.ndarray
    recording: Recording

    def calibrated(self, **told) -> Calibration:
        return Calibration.of(self.robot, self.recording, **({"sigma_m": None, "zeros_rad": ZEROS_RAD} | told))


@functools.cache
def planted(seed: int, *, pairs: int = 100, sigma: float = SIGMA_M, outliers: int = 0) -> Planted:
    """Return an arm built to 0.17° and 1 mm, its inner joint offsets 3°, camera and marker anywhere (1-sigma)."""
    rng = np.random.default_rng(seed)
    robot = RobotDescription.load(DESK_ARM)
    parameters = ChainParameters(robot.chain)
    made = ChainTolerances(0.003, 0.001, ZEROS_RAD, tool=0.03, base_rotation=0.5, base_translation=0.5)
    change = parameters.standard_deviations(made) * rng.normal(size=parameters.size)
    zeros = change[parameters.zeros]
    zeros[[0, -1]] = 0.0  # equivalent to a rotation of camera and marker in any motion
    q = rng.uniform(robot.lower, robot.upper, (pairs, 4))
    x = parameters.positions(change, q) + sigma * rng.normal(size=(pairs, 3))
    x[:outliers] += 0.1
    return Planted(robot, parameters, change, Recording(joints=robot.joints, q=q, x=x))


# --- results


@functools.cache
def report_on(arm: Planted) -> CalibrationReport:
    return CalibrationReport.of(arm.calibrated(), Plausibility(), "pairs.csv")


def test_identifiable_joint_offsets_are_recovered_without_noise() -> None:
    arm = planted(1, sigma=0.0)
    zeros = [zero for zero in report_on(arm).zeros if zero.half_width is not None]
    assert [zero.joint for zero in zeros] == ["shoulder_pitch", "elbow_pitch"]
    off = np.abs([zero.zero for zero in zeros] - np.degrees(arm.change[arm.parameters.zeros][1:3]))
    assert (off < [zero.half_width for zero in zeros]).all()


def test_calibrated_arm_predicts_truth_within_the_noise() -> None:
    arm = planted(2)
    q = np.random.default_rng(0).uniform(arm.robot.lower, arm.robot.upper, (200, 4))
    off = np.linalg.norm(arm.calibrated().learner.predict(q) - arm.parameters.positions(arm.change, q), axis=1)
    assert off.mean() < SIGMA_M


def covered(seeds: range) -> float:
    """Return the share of the figures whose true values lie inside their intervals."""
    inside: list[bool] = []
    for seed in seeds:
        arm = planted(seed)
        found = arm.calibrated().figures
        off = found.values - figures_of(arm)
        told = np.append(np.ones(9, dtype=bool), found.shown)
        inside += (np.abs(off) < found.half_widths)[told].tolist()
    return float(np.mean(inside))


def figures_of(arm: Planted) -> np.ndarray:
    """Return the figures that an error-free calibration would find."""
    zeros = arm.change[arm.parameters.zeros]
    pose = arm.parameters.base_pose(arm.change)
    chain = arm.parameters.chain(arm.change)
    geometry = CalibratedGeometry.of(arm.robot, chain, T_measured_nominal=pose, zeros=zeros)
    camera = geometry.T_parent_camera
    return np.concatenate([camera[:3, 3], rpy_of(camera[:3, :3]), geometry.marker_xyz, zeros])


def test_the_intervals_cover_what_was_planted() -> None:
    assert covered(range(1, 3)) > 0.8  # the figures of one arm go together


@pytest.mark.soak
def test_the_95_percent_intervals_cover_95_percent() -> None:
    assert 0.93 < covered(range(200)) < 0.97


def test_outliers_are_counted_and_left_out() -> None:
    assert report_on(planted(3, outliers=4)).outliers == 4


def test_too_few_pairs_are_rejected() -> None:
    with pytest.raises(CalibrationError, match="7 samples are too few to calibrate 4 joints; record at least 8"):
        planted(1, pairs=7).calibrated()


def test_camera_and_tool_alone_need_fewer_pairs() -> None:
    found = planted(0, pairs=7).calibrated(trusted="urdf")
    with pytest.raises(CalibrationError, match="5 samples are too few to calibrate 4 joints; record at least 6"):
        planted(0, pairs=5).calibrated(trusted="urdf")
    assert found.learner.inliers.all()


def test_first_offset_is_unidentifiable_from_distant_instrument() -> None:
    arm = planted(0)
    far = dataclasses.replace(arm.recording, x=arm.recording.x + np.array([0.0, 0.0, 10.0]))
    found = dataclasses.replace(arm, recording=far).calibrated()
    assert found.figures.shown.tolist() == [False, True, True, False]
    assert found.figures.half_widths[:3].max() < 0.1


def test_many_outliers_are_mentioned_with_their_rows() -> None:
    assert "20 % of the samples do not fit" in said(planted(0, outliers=20))
    assert "(the longest run: number 1 to 20)" in said(planted(0, outliers=20))
    assert "do not fit" not in said(planted(0, outliers=5))


def test_marker_that_never_moved_is_rejected() -> None:
    arm = planted(1)
    still = Recording(joints=arm.robot.joints, q=arm.recording.q, x=np.ones((100, 3)))
    with pytest.raises(CalibrationError, match="no chain can be fitted to the recording: the measured positions x lie"):
        Calibration.of(arm.robot, still, sigma_m=None, zeros_rad=ZEROS_RAD)


# --- messages


def said(arm: Planted, **changed) -> str:
    return "\n".join(sentences(msgspec.structs.replace(report_on(arm), **changed)))


def test_unidentifiable_offsets_are_reported_as_kept_at_nominal() -> None:
    assert "Kept at nominal: base_yaw, wrist_roll. The measurements cannot separate" in said(planted(1))


def test_a_joint_that_hardly_moved_is_named() -> None:
    arm = planted(1)
    q = arm.recording.q.copy()
    q[:, 2] *= 0.01
    recording = Recording(joints=arm.robot.joints, q=q, x=arm.parameters.positions(arm.change, q))
    assert "Hardly moved: elbow_pitch." in said(dataclasses.replace(arm, recording=recording))


def test_estimated_noise_is_independent_of_stated_covariance() -> None:
    arm = planted(1)
    told = Recording(arm.robot.joints, arm.recording.q, arm.recording.x, cov=np.tile(0.003**2 * np.eye(3), (100, 1, 1)))
    report = report_on(dataclasses.replace(arm, recording=told))
    assert report.noise_mm == pytest.approx(1e3 * SIGMA_M, rel=0.15)
    assert report.told_noise_mm == pytest.approx(3.0)


@pytest.fixture(scope="module")
def corner() -> CalibrationReport:
    """Return the calibration from twelve pairs within a few degrees."""
    arm = planted(1)
    q = arm.recording.q[0] + 0.05 * np.random.default_rng(0).normal(size=(12, 4))
    x = arm.parameters.positions(arm.change, q) + SIGMA_M * np.random.default_rng(1).normal(size=(12, 3))
    return report_on(dataclasses.replace(arm, recording=Recording(arm.robot.joints, q, x)))


def test_twelve_nearby_pairs_yield_no_manufacturing_accuracy(corner) -> None:
    assert (corner.axes_deg, corner.points_mm) == (None, None)
    assert "These samples do not show how accurately the arm is made" in "\n".join(sentences(corner))


def test_twelve_nearby_pairs_determine_few_parameters(corner) -> None:
    assert corner.shown < 0.8 * corner.showable


def test_varied_pairs_determine_all_parameters_and_manufacturing_accuracy() -> None:
    report = report_on(planted(1))
    assert report.shown == report.showable
    assert report.axes_deg is not None
    assert 0.3 < report.axes_deg / np.degrees(0.003) < 3.4  # one step of the choices


def moving(late_s: float) -> CalibrationReport:
    """Return the report on an arm that moves in two runs, its positions stamped `late_s` late."""
    arm = planted(3)
    t = np.concatenate([np.arange(0.0, 10.0, 0.1), 100.0 + np.arange(0.0, 10.0, 0.1)])
    middle, swing = (arm.robot.lower + arm.robot.upper) / 2.0, (arm.robot.upper - arm.robot.lower) / 6.0
    q, measured = (middle + swing * np.sin(np.outer(at, [0.3, 0.5, 0.7, 1.1])) for at in (t, t - late_s))
    x = arm.parameters.positions(arm.change, measured) + SIGMA_M * np.random.default_rng(4).normal(size=(len(t), 3))
    recording = Recording(joints=arm.robot.joints, q=q, x=x, t=t, segment=np.repeat([0, 1], 100))
    return report_on(dataclasses.replace(arm, recording=recording))


def test_positions_stamped_late_or_early_are_doubted() -> None:
    assert "stamped too late" in (moving(0.01).doubt or "")
    assert "stamped too early" in (moving(-0.01).doubt or "")


def test_positions_stamped_in_time_are_not_doubted() -> None:
    assert moving(0.0).doubt is None


@pytest.mark.parametrize(("sigma", "doubted"), [(1e-6, True), (1e-4, False)])
def test_positions_that_follow_from_the_joints_are_doubted(sigma: float, doubted: bool) -> None:
    arm = planted(3)
    x = arm.robot.chain.positions(arm.recording.q) + sigma * np.random.default_rng(4).normal(size=(100, 3))
    report = report_on(dataclasses.replace(arm, recording=dataclasses.replace(arm.recording, x=x)))
    assert ("computed from the joints" in (report.doubt or "")) == doubted


def test_residuals_exceeding_the_stated_noise_are_reported() -> None:
    assert "residuals are 3.0 times what the noise explains" in said(planted(1), misfit=3.0)


def test_unidentified_offset_leaves_marker_position_unchanged() -> None:
    """Of an arm whose shoulder alone moves, a turn of the shoulder's zero and one of the marker look alike."""
    arm = planted(1)
    q = arm.recording.q * [1.0, 1.0, 0.0, 0.0]
    x = arm.parameters.positions(arm.change, q) + SIGMA_M * np.random.default_rng(2).normal(size=(len(q), 3))
    figures = Calibration.of(
        arm.robot, Recording(joints=arm.robot.joints, q=q, x=x), sigma_m=None, zeros_rad=ZEROS_RAD, trusted="links"
    ).figures
    assert not figures.shown.any()
    belief, k = figures.beliefs[0], range(arm.parameters.size)[arm.parameters.zeros][1]
    alike = np.radians(1.0) * belief.covariance[:, k] / belief.covariance[k, k]
    other = dataclasses.replace(figures, beliefs=(dataclasses.replace(belief, mean=belief.mean + alike),))
    np.testing.assert_allclose(other.values[6:9], figures.values[6:9], rtol=0, atol=5e-4)


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


def test_written_robot_matches_the_calibrated_chain(pairs_file, tmp_path, capsys) -> None:
    called(pairs_file, "--out", tmp_path / "calibrated")
    said = capsys.readouterr().out.replace("\n", " ")
    assert "robot.toml written. Next: stop what runs with robot.toml (the new one has its ports), then" in said
    written = Config.load(tmp_path / "calibrated" / "robot.toml", {}).robot
    robot = RobotDescription.load(DESK_ARM)
    read = Recording.read(pairs_file, robot.joints)
    learnt = Calibration.of(robot, read, sigma_m=None, zeros_rad=np.radians(3.0)).learner.chain
    np.testing.assert_allclose(written.chain.positions(read.q), learnt.positions(read.q), rtol=0, atol=1e-9)


def test_json_has_every_figure(pairs_file, capsys) -> None:
    called(pairs_file, "--json")
    found = msgspec.json.decode(capsys.readouterr().out, type=CalibrationReport)
    assert (found.pairs, len(found.camera_rpy_deg), len(found.zeros)) == (100, 3, 4)


CAMERAS = """
[vision.cameras]
calibration = "cameras.toml"
[vision.cameras.two]
left = "/dev/v4l/by-id/usb-A-video-index0"
right = "/dev/v4l/by-id/usb-B-video-index0"
image_size_px = [640, 480]
"""


def test_output_states_whether_intervals_include_camera_calibration(pairs_file, capsys) -> None:
    robot = pairs_file.with_name("robot.toml")
    robot.write_text(robot.read_text() + CAMERAS)
    called(pairs_file)
    said = " ".join(capsys.readouterr().out.split())
    assert "The intervals leave out how well the cameras are calibrated" in said
    assert "cameras.toml: there is no such file" in said
    lens = Lens("pinhole", (600.0, 600.0), (319.5, 239.5), (0.0,) * 5)
    made = CalibrationProvenance("", "", 20, 0, 0.0, 0.0, 0.0)
    rig = StereoRig(lens, lens, np.zeros(3), np.array([-0.1, 0.0, 0.0]), (640, 480), ("", ""), 1e-8 * np.eye(24), made)
    write_rig(rig, robot.with_name("cameras.toml"))
    called(pairs_file)
    said = " ".join(capsys.readouterr().out.split())
    assert "The intervals contain the cameras' calibration, which leaves " in said
    assert "give a robot.toml without `calibration` in [vision.cameras]" in said


@pytest.mark.parametrize(
    ("taken", "elsewhere"),
    [
        (SourceOptions(), True),
        (SourceOptions(video="/camera"), False),
        (SourceOptions(video="/camera", markers=Path("tracker.csv")), True),
    ],
)
def test_bag_positions_are_not_of_the_configured_cameras(tmp_path, taken, elsewhere) -> None:
    (tmp_path / "metadata.yaml").touch()
    assert seen_elsewhere(tmp_path, taken) is elsewhere
    assert not seen_elsewhere(tmp_path / "pairs.csv", taken)


def test_a_store_of_other_joints_is_refused() -> None:
    recording = planted(1).recording
    with pytest.raises(
        RecordingError, match=r"pairs.sqlite: the samples are of other joints: base_yaw, .*this one has a"
    ):
        of_robot(recording, ("a", "b"), Path("pairs.sqlite"))


def test_urdf_export_of_pairs_points_to_calibrate(pairs_file, tmp_path) -> None:
    with pytest.raises(
        RecordingError, match=r"a URDF is of a robot, not of samples. `bodyschema calibrate` learns one"
    ):
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


# --- other units, another order, another robot


def written_as(
    file: Path, *, order: tuple[int, ...] = (0, 1, 2, 3), q_scale: float = 1.0, x_scale: float = 1.0
) -> None:
    pairs = planted(1).recording
    Recording(pairs.joints, q_scale * pairs.q[:, order], x_scale * pairs.x).write_csv(file)


def test_positions_in_millimetres_are_refused(pairs_file) -> None:
    written_as(pairs_file, x_scale=1e3)
    with pytest.raises(RecordingError, match=r"the arm reaches 0.57 m: these look like millimetres. .* divide by 1000"):
        called(pairs_file)


def test_angles_in_degrees_are_refused(pairs_file) -> None:
    written_as(pairs_file, q_scale=float(np.degrees(1.0)))
    with pytest.raises(RecordingError, match=r"limits from .* rad \(.*\): these look like degrees"):
        called(pairs_file)


def test_exchanged_columns_are_refused_and_nothing_written(pairs_file, tmp_path) -> None:
    written_as(pairs_file, order=(1, 0, 2, 3))
    with pytest.raises(RecordingError, match=r"it seems that the columns base_yaw and shoulder_pitch are exchanged"):
        called(pairs_file, "--out", tmp_path / "calibrated")
    assert not (tmp_path / "calibrated").exists()


@pytest.mark.soak  # of the check: test_plausibility; that --force writes: test_calibration_options
def test_force_writes_what_is_refused(pairs_file, tmp_path, capsys) -> None:
    written_as(pairs_file, order=(1, 0, 2, 3))
    called(pairs_file, "--out", tmp_path / "calibrated", "--force")
    assert "the columns base_yaw and shoulder_pitch are exchanged" in capsys.readouterr().out.replace("\n", " ")
    assert (tmp_path / "calibrated" / "robot.toml").exists()


def write_with_a_zero_far_off(file: Path) -> None:
    arm = planted(1)
    change = arm.change.copy()
    change[arm.parameters.zeros] += [0.0, np.radians(25.0), 0.0, 0.0]
    q = arm.recording.q
    Recording(arm.robot.joints, q, arm.parameters.positions(change, q)).write_csv(file)


def test_offset_far_beyond_tolerance_is_not_written(pairs_file, tmp_path) -> None:
    write_with_a_zero_far_off(pairs_file)
    with pytest.raises(CalibrationError, match=r"nothing was written. .* zero of shoulder_pitch comes out .* --force"):
        called(pairs_file, "--out", tmp_path / "calibrated")
    assert not (tmp_path / "calibrated").exists()


def test_unwritten_pose_is_not_printed_for_ros(pairs_file, capsys) -> None:
    called(pairs_file)
    assert "static_transform_publisher" in capsys.readouterr().out
    write_with_a_zero_far_off(pairs_file)
    called(pairs_file)
    assert "static_transform_publisher" not in capsys.readouterr().out


def test_offset_within_the_stated_tolerance_is_written(pairs_file, tmp_path) -> None:
    called(pairs_file, "--out", tmp_path / "calibrated", "--zeros-deg", 10)
    assert (tmp_path / "calibrated" / "robot.toml").exists()


def test_links_worse_than_any_are_not_written(pairs_file, tmp_path) -> None:
    arm = planted(1)
    change, rng = arm.change.copy(), np.random.default_rng(0)
    change[arm.parameters.shifts] += 0.045 * rng.normal(size=8)
    change[arm.parameters.tilts] += 0.09 * rng.normal(size=8)
    q = arm.recording.q
    Recording(arm.robot.joints, q, arm.parameters.positions(change, q)).write_csv(pairs_file)
    with pytest.raises(CalibrationError, match=r"nothing was written. .* the worst that is considered. .* another arm"):
        called(pairs_file, "--out", tmp_path / "calibrated")
    assert not (tmp_path / "calibrated").exists()


# --- pairs of two tools


def retooled(seed: int, at: int, move_m: float, *, walk: bool = False) -> Planted:
    """Return an arm whose tool was changed after `at` of its pairs."""
    arm = planted(seed)
    q, rng = arm.recording.q, np.random.default_rng(seed)
    if walk:
        q = np.cumsum(np.radians(3.0) * rng.normal(size=(100, 4)), axis=0) + 0.5 * q[:1]
    change = arm.change.copy()
    change[arm.parameters.tool] += [0.0, 0.6 * move_m, 0.8 * move_m]
    x = np.vstack([arm.parameters.positions(arm.change, q[:at]), arm.parameters.positions(change, q[at:])])
    x += SIGMA_M * rng.normal(size=x.shape)
    return dataclasses.replace(arm, recording=Recording(joints=arm.robot.joints, q=q, x=x))


@pytest.mark.parametrize(
    ("at", "walk"),
    [(20, False), *(pytest.param(*case, marks=pytest.mark.soak) for case in ((50, True), (50, False), (82, False)))],
)
def test_first_row_of_another_tool_is_found(at: int, walk: bool) -> None:
    report = report_on(retooled(5, at, 0.05, walk=walk))
    assert report.other_tool_from == at + 1
    assert report.other_tool_mm == pytest.approx(50.0, rel=0.35)


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.soak) for seed in (1, 2, 3))])
def test_one_tool_is_not_taken_for_two(seed: int) -> None:
    assert report_on(planted(seed, pairs=24 + 30 * seed, outliers=2 * seed)).other_tool_from is None


def few_of(arm: Planted, rows: np.ndarray) -> CalibrationReport:
    recording = Recording(joints=arm.robot.joints, q=arm.recording.q[rows], x=arm.recording.x[rows])
    return report_on(dataclasses.replace(arm, recording=recording))


def test_few_rows_show_only_large_tool_changes() -> None:
    rows = np.r_[10:20, 20:30]
    assert few_of(retooled(5, 20, 0.05), rows).other_tool_from == 11
    assert few_of(retooled(5, 20, 0.002), rows).other_tool_from is None


def test_pairs_of_two_tools_are_reported_with_remedy() -> None:
    text = said(planted(1), other_tool_from=601, other_tool_mm=248.0)
    assert "From number 601 on the marker sits about 248 mm elsewhere on gripper" in text
    assert "--first 601, or --last 600" in text


def test_of_two_tools_nothing_is_written(pairs_file, tmp_path) -> None:
    retooled(5, 50, 0.05).recording.write_csv(pairs_file)
    with pytest.raises(CalibrationError, match=r"nothing was written. From number 51 on"):
        called(pairs_file, "--out", tmp_path / "calibrated")
    assert not (tmp_path / "calibrated").exists()


def test_each_tool_can_be_calibrated_alone(pairs_file, capsys) -> None:
    retooled(5, 50, 0.05).recording.write_csv(pairs_file)
    found = []
    for rows in (("--last", 50), ("--first", 51)):
        called(pairs_file, "--json", *rows)
        found.append(msgspec.json.decode(capsys.readouterr().out, type=CalibrationReport))
    assert [(report.pairs, report.first, report.other_tool_from) for report in found] == [(50, 1, None), (50, 51, None)]


def test_missing_rows_are_reported(pairs_file) -> None:
    with pytest.raises(RecordingError, match=r"no samples from number 101 on; the last one is 100"):
        called(pairs_file, "--first", 101)


# --- the store of a running robot


@pytest.fixture
def robot_with_store(tmp_path) -> Path:
    """Return robot.toml of an arm whose store has 20 pairs with one tool and 30 with another, known to its learner."""
    shutil.copytree(DESK_ARM.parent, tmp_path / "arm")
    robot = tmp_path / "arm" / "robot.toml"
    robot.write_text(robot.read_text() + '\n[daemon]\nstate_dir = "state"\n')
    config = Config.load(robot, {})
    arm = retooled(5, 50, 0.05)
    learning = OnlineLearner(NominalModel.of(config.robot), config.tables.learner, DirectSolver())
    with PairStore(config.store_file, session_of(config, SystemClock())) as store:
        for row in range(30, 80):
            if row == 50:
                learning.tool_changed()
            fix = MarkerFix(t=float(row), x=arm.recording.x[row], cov=1e-6 * np.eye(3))
            learning.learn(store.append(1, "", arm.recording.q[row], fix), 0.0)
    write_checkpoint(config.checkpoint_file, learning.state(), robot=config.robot.name, utc="")
    return robot


def report_of(capsys, *arguments: object) -> CalibrationReport:
    called("--json", *arguments)
    return msgspec.json.decode(capsys.readouterr().out, type=CalibrationReport)


def test_store_calibration_uses_pairs_of_current_tool_only(robot_with_store, capsys) -> None:
    report = report_of(capsys, robot_with_store.parent / "state" / "pairs.sqlite", "--robot", robot_with_store)
    assert (report.first, report.pairs, report.other_tool_from) == (21, 30, None)


def test_default_source_is_the_robot_s_own_store(robot_with_store, capsys) -> None:
    assert report_of(capsys, "--robot", robot_with_store).source == "pairs.sqlite"


def test_the_robot_that_the_environment_names_is_calibrated(robot_with_store, capsys, monkeypatch) -> None:
    monkeypatch.setenv("BODYSCHEMA_ROBOT", str(robot_with_store))
    assert report_of(capsys).source == "pairs.sqlite"


def test_first_option_selects_all_pairs_of_store(robot_with_store, capsys) -> None:
    report = report_of(capsys, "--robot", robot_with_store, "--first", 1)
    assert (report.pairs, report.other_tool_from) == (50, 21)


def test_store_without_checkpoint_is_used_from_first_pair(robot_with_store, capsys) -> None:
    (robot_with_store.parent / "state" / "learner.ckpt").unlink()
    assert report_of(capsys, "--robot", robot_with_store).first == 1


def test_unreadable_checkpoint_is_ignored(robot_with_store, capsys) -> None:
    (robot_with_store.parent / "state" / "learner.ckpt").write_bytes(b"nothing")
    assert report_of(capsys, "--robot", robot_with_store).first == 1
