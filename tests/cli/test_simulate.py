from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from small_arm import JOINTS, write_small_arm

from bodyschema.cli.main import app
from bodyschema.daemon.config import Config
from bodyschema.effects import load_simulation
from bodyschema.interfaces.errors import ConfigError, RecordingError, RequestError
from bodyschema.recordings.recording import Recording, joints_in
from bodyschema.robot.toml_file import read_toml

ROWS = 50
EFFECT = '[[effects]]\neffect = "joint_offset"\nwhere = "waist"\noffset_rad = 0.05\n'
LATE = '[[effects]]\neffect = "camera_latency"\nlatency_s = 0.02\n'
SPRING = "compliance_rad_per_Nm = 0.01\n"
STEREO = "focal_px = 700.0\nprincipal_point_px = [640.0, 480.0]\nbaseline_m = 0.2\nimage_size_px = [1280, 960]\n"


def called(*arguments: object) -> None:
    app(list(map(str, arguments)), exit_on_error=False, result_action="return_value")


def measured(file: Path, *, times: bool = True, sigma_m: float | None = None, rows: int = ROWS) -> Recording:
    """Write a recording of the small arm to `file` and return it."""
    rng = np.random.default_rng(1)
    q = rng.uniform(-1, 1, (ROWS, 2))[:rows]
    x = np.column_stack([np.cos(q[:, 0]), np.sin(q[:, 0]), q[:, 1]]) * 0.2
    recording = Recording(
        joints=JOINTS,
        q=q,
        x=x,
        t=np.arange(rows) / 30 if times else None,
        segment=np.arange(rows) // 20,
        cov=None if sigma_m is None else np.tile(sigma_m**2 * np.eye(3), (rows, 1, 1)),
    )
    recording.write_csv(file)
    return recording


def simulated(folder: Path, *options: object, tables: str = EFFECT) -> Recording:
    robot = write_small_arm(folder, tables)
    called("simulate", "--like", folder / "like.csv", "--robot", robot, "--out", folder / "out.csv", *options)
    return Recording.read(folder / "out.csv", JOINTS)


# --- simulate


@pytest.mark.parametrize("times", [True, False])
def test_the_simulation_measures_at_the_recording_s_joint_angles(tmp_path, times) -> None:
    like = measured(tmp_path / "like.csv", times=times)
    out = simulated(tmp_path)
    np.testing.assert_array_equal(out.q, like.q)
    assert (out.t is None) is not times
    np.testing.assert_array_equal(out.segment, like.segment)
    robot = Config.load(tmp_path / "robot.toml").robot
    np.testing.assert_allclose(out.x, robot.chain.positions(like.q + np.array([0.05, 0.0])), atol=1e-12)


def test_parquet_has_the_same_numbers(tmp_path) -> None:
    measured(tmp_path / "like.csv")
    out = simulated(tmp_path)
    called("simulate", "--like", tmp_path / "like.csv", "--out", tmp_path / "out.parquet")
    np.testing.assert_array_equal(Recording.read(tmp_path / "out.parquet", JOINTS).x, out.x)
    assert joints_in(tmp_path / "out.parquet") == JOINTS


def test_json_has_rows_written_and_file(tmp_path, capsys) -> None:
    measured(tmp_path / "like.csv")
    simulated(tmp_path, "--json")
    told = json.loads(capsys.readouterr().out)
    assert (told["file"], told["rows"], told["effects"]) == (str(tmp_path / "out.csv"), ROWS, 1)


def test_json_without_a_file_is_refused(tmp_path) -> None:
    measured(tmp_path / "like.csv")
    robot = write_small_arm(tmp_path, EFFECT)
    with pytest.raises(RequestError, match="--json needs --out"):
        called("simulate", "--like", tmp_path / "like.csv", "--robot", robot, "--json")


def test_rows_go_to_stdout_without_a_file(tmp_path, capsys) -> None:
    measured(tmp_path / "like.csv")
    out = simulated(tmp_path)
    capsys.readouterr()
    called("simulate", "--like", tmp_path / "like.csv")
    assert capsys.readouterr().out == (tmp_path / "out.csv").read_text()
    assert len(out) == ROWS


def test_the_noise_is_that_of_the_recording(tmp_path) -> None:
    measured(tmp_path / "like.csv", sigma_m=0.003)
    exact, noisy = simulated(tmp_path), simulated(tmp_path, "--noise", "--force")
    assert 0.002 < (noisy.x - exact.x).std() < 0.004  # 150 numbers: the spread of their 3 mm is 0.17 mm


def test_else_the_noise_is_that_of_the_cameras(tmp_path) -> None:
    measured(tmp_path / "like.csv")
    tables = f"xyz = [0.0, 0.0, -3.0]\n{STEREO}{EFFECT}"
    exact, noisy = simulated(tmp_path, tables=tables), simulated(tmp_path, "--noise", "--force", tables=tables)
    misses = (noisy.x - exact.x) / exact.x[:, 2:] ** 2
    # z²/(f b) times the noise of a disparity, 0.2 px · √2
    assert misses[:, 2].std() == pytest.approx(0.2 * 2**0.5 / (700.0 * 0.2), rel=0.5)


def test_noise_of_unknown_size_is_refused(tmp_path) -> None:
    measured(tmp_path / "like.csv")
    with pytest.raises(ConfigError, match="nothing says how large the noise is"):
        simulated(tmp_path, "--noise")


def test_camera_latency_without_times_warns(tmp_path, capsys) -> None:
    measured(tmp_path / "like.csv", times=False)
    simulated(tmp_path, tables=LATE)
    assert "camera_latency changes nothing: the recording has no column t" in capsys.readouterr().err


def test_a_file_that_is_there_is_kept(tmp_path) -> None:
    measured(tmp_path / "like.csv")
    simulated(tmp_path)
    with pytest.raises(RecordingError, match="is there already"):
        simulated(tmp_path)


# --- the file with effects


def test_config_check_names_the_effects(tmp_path, capsys) -> None:
    called("config", "--robot", write_small_arm(tmp_path, EFFECT))
    assert "effect joint_offset at waist: offset_rad = 0.05" in capsys.readouterr().out


def test_spring_without_load_is_reported_as_ineffective(tmp_path, capsys) -> None:
    file = write_small_arm(tmp_path, '[[effects]]\neffect = "joint_compliance"\nwhere = "waist"\n' + SPRING)
    file.write_text(file.read_text().replace("[camera]", 'hold = "torque_free"\n[camera]'))
    called("config", "--robot", file)
    assert "the guiding hand bears" in capsys.readouterr().out


def test_wrong_effect_is_refused_when_loading_config(tmp_path) -> None:
    with pytest.raises(ConfigError, match=r"robot\.toml, line 11: effect 1: .*looks like degrees"):
        Config.load(write_small_arm(tmp_path, EFFECT.replace("0.05", "5.0")))


def test_the_environment_changes_no_effects(tmp_path) -> None:
    config = Config.load(write_small_arm(tmp_path, EFFECT), {"BODYSCHEMA_EFFECTS_OFFSET_RAD": "1"})
    assert config.simulation.effects[0].value("offset_rad") == 0.05


def test_calibrated_robot_file_contains_no_effects(tmp_path) -> None:
    from bodyschema.robot.calibrated import CalibratedGeometry
    from bodyschema.robot.calibrated_files import write_calibrated

    robot = load_simulation(write_small_arm(tmp_path, EFFECT)).robot
    geometry = CalibratedGeometry.of(robot, robot.chain, T_measured_nominal=np.eye(4), zeros=np.zeros(2))
    file = write_calibrated(robot, geometry, tmp_path / "calibrated", "Calibrated by a test")
    assert "effects" not in read_toml(file)[0]


# --- compare


def compared(capsys, *arguments: object) -> dict:
    called("compare", *arguments, "--json")
    return json.loads(capsys.readouterr().out)


def moved(recording: Recording, by) -> Recording:
    return Recording(joints=recording.joints, q=recording.q, x=recording.x + by, t=recording.t)


def test_constant_shift_is_measured_and_removed_by_alignment(tmp_path, capsys) -> None:
    moved(measured(tmp_path / "a.csv"), [0.003, 0.0, -0.004]).write_csv(tmp_path / "b.csv")
    report = compared(capsys, tmp_path / "a.csv", tmp_path / "b.csv")
    assert report["distances"] == pytest.approx({"mean_mm": 5, "rms_mm": 5, "median_mm": 5, "max_mm": 5})
    assert report["axis_mean_mm"] == pytest.approx([3, 0, -4], abs=1e-9)
    assert report["aligned"]["distances"]["max_mm"] == pytest.approx(0, abs=1e-9)
    assert report["aligned"]["shift_mm"] == pytest.approx([-3, 0, 4], abs=1e-9)


def test_rotation_is_reported_by_its_angle(tmp_path, capsys) -> None:
    recording = measured(tmp_path / "a.csv")
    angle = np.radians(2.0)
    R = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    Recording(joints=JOINTS, q=recording.q, x=recording.x @ R.T).write_csv(tmp_path / "b.csv")
    aligned = compared(capsys, tmp_path / "a.csv", tmp_path / "b.csv")["aligned"]
    assert aligned["turn_deg"] == pytest.approx(2.0)
    assert aligned["distances"]["max_mm"] == pytest.approx(0, abs=1e-9)


def test_the_worst_rows_come_first_with_their_numbers(tmp_path, capsys) -> None:
    by = np.zeros((ROWS, 3))
    by[[6, 30], 0] = [0.01, 0.02]
    moved(measured(tmp_path / "a.csv"), by).write_csv(tmp_path / "b.csv")
    worst = compared(capsys, tmp_path / "a.csv", tmp_path / "b.csv")["worst"]
    assert [(row["row"], round(row["distance_mm"], 6)) for row in worst[:2]] == [(31, 20.0), (7, 10.0)]


def test_rows_without_counterpart_are_skipped_and_reported(tmp_path, capsys) -> None:
    recording = measured(tmp_path / "a.csv")
    q = recording.q.copy()
    q[4, 1] += 0.01
    Recording(joints=JOINTS, q=q, x=recording.x).write_csv(tmp_path / "b.csv")
    left_out = compared(capsys, tmp_path / "a.csv", tmp_path / "b.csv")["left_out"]
    assert (left_out["first"], left_out["first_row"], left_out["joint"]) == (1, 5, "shoulder")
    assert left_out["by"] == pytest.approx(0.01)
    called("compare", tmp_path / "a.csv", tmp_path / "b.csv")
    assert "Not compared" in " ".join(capsys.readouterr().out.split())


def test_recordings_of_different_lengths_match_by_joint_angles(tmp_path, capsys) -> None:
    recording = measured(tmp_path / "a.csv")
    recording.rows(np.arange(ROWS) % 3 == 1).write_csv(tmp_path / "b.csv")
    report = compared(capsys, tmp_path / "a.csv", tmp_path / "b.csv")
    assert (report["rows"], report["other_rows"], report["compared"]) == (50, 17, 17)
    assert report["distances"]["max_mm"] == 0.0


def test_recordings_without_common_row_are_refused_with_remedy(tmp_path) -> None:
    recording = measured(tmp_path / "a.csv")
    Recording(joints=JOINTS, q=recording.q + 0.1, x=recording.x).write_csv(tmp_path / "b.csv")
    with pytest.raises(RecordingError, match=r"no row at the joint angles.*differs by 0\.1.*simulate --like"):
        called("compare", tmp_path / "a.csv", tmp_path / "b.csv")


def test_recordings_of_other_joints_are_refused(tmp_path) -> None:
    recording = measured(tmp_path / "a.csv")
    Recording(joints=("waist", "elbow"), q=recording.q, x=recording.x).write_csv(tmp_path / "b.csv")
    with pytest.raises(RecordingError, match="only one of them has elbow, shoulder"):
        called("compare", tmp_path / "a.csv", tmp_path / "b.csv")


def test_columns_in_another_order_are_the_same_joints(tmp_path, capsys) -> None:
    recording = measured(tmp_path / "a.csv")
    Recording(joints=JOINTS[::-1], q=recording.q[:, ::-1], x=recording.x).write_csv(tmp_path / "b.csv")
    assert compared(capsys, tmp_path / "a.csv", tmp_path / "b.csv")["compared"] == ROWS


def test_compare_with_a_robot_uses_its_joints(tmp_path, capsys) -> None:
    measured(tmp_path / "a.csv")
    robot = write_small_arm(tmp_path)
    assert compared(capsys, tmp_path / "a.csv", tmp_path / "a.csv", "--robot", robot)["joints"] == list(JOINTS)
    (tmp_path / "a.csv").write_text((tmp_path / "a.csv").read_text().replace("waist", "hip"))
    with pytest.raises(RecordingError, match="no column for the joint 'waist'"):
        called("compare", tmp_path / "a.csv", tmp_path / "a.csv", "--robot", robot)
