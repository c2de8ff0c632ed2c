from __future__ import annotations

from pathlib import Path

import pytest
from small_arm import ROBOT, write_small_arm

from bodyschema.daemon.config import Config, ZenohConfig
from bodyschema.interfaces.errors import ConfigError, RobotError


def load(folder: Path, tables: str = "", environment: dict[str, str] | None = None) -> Config:
    return Config.load(write_small_arm(folder, tables), environment or {})


def test_absent_table_uses_defaults(tmp_path) -> None:
    assert load(tmp_path).tables.zenoh == ZenohConfig()


def test_the_file_overrides_the_defaults(tmp_path) -> None:
    assert load(tmp_path, "[daemon]\nmax_step_deg = 5\n").tables.daemon.max_step_deg == 5.0


def test_the_environment_overrides_the_file(tmp_path) -> None:
    environment = {"BODYSCHEMA_DAEMON_MAX_STEP_DEG": "7.5", "BODYSCHEMA_ZENOH_SAMPLER": "tcp/127.0.0.1:9"}
    tables = load(tmp_path, "[daemon]\nmax_step_deg = 5\n", environment).tables
    assert (tables.daemon.max_step_deg, tables.zenoh.sampler) == (7.5, "tcp/127.0.0.1:9")


def test_a_retired_key_in_the_environment_only_warns(tmp_path, caplog) -> None:
    load(tmp_path, environment={"BODYSCHEMA_VISION_EPIPOLAR_PX": "1"})
    assert "BODYSCHEMA_VISION_EPIPOLAR_PX is no key any more" in caplog.text


def test_variables_of_other_programs_are_ignored(tmp_path, caplog) -> None:
    load(tmp_path, environment={"LEARNER_SEED": "1", "DAEMON_KEEP_NEWEST": "2"})
    assert not caplog.records


def test_retired_keys_in_arrays_of_tables_warn(tmp_path, caplog) -> None:
    cameras = 'latency_s = 0.0\n[vision.cameras.images]\nleft = "a/*.png"\nright = "b/*.png"\nfps = 30\n'
    two = 'image_size_px = [640, 480]\nleft = "/dev/v4l/by-id/a"\nright = "/dev/v4l/by-id/b"\nmax_apart_s = 0.1\n'
    further = "".join(
        f'[[vision.further_cameras]]\nname = "{name}"\ncalibration = "c.toml"\n[vision.further_cameras.two]\n{two}'
        for name in ("side", "top")
    )
    load(tmp_path, f"[vision.cameras]\n{cameras}{further}")
    assert [record.getMessage().count("max_apart_s is no key any more") for record in caplog.records] == [1, 1]


def test_the_environment_reaches_the_robot(tmp_path) -> None:
    assert load(tmp_path, environment={"BODYSCHEMA_ROBOT_NAME": "twin"}).robot.name == "twin"


def test_robot_toml_path_variable_is_not_a_setting(tmp_path) -> None:
    assert load(tmp_path, environment={"BODYSCHEMA_ROBOT": "elsewhere.toml"}).robot.name == "arm"


def test_state_dir_is_relative_to_robot_toml(tmp_path) -> None:
    assert load(tmp_path, '[daemon]\nstate_dir = "state"\n').store_file == tmp_path / "state" / "pairs.sqlite"


def test_default_state_dir_follows_xdg_state_home(tmp_path, monkeypatch) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "xdg"))
    assert load(tmp_path).state_dir == tmp_path / "xdg" / "bodyschema" / "arm"


def test_the_command_lines_state_dir_comes_first(tmp_path) -> None:
    config = load(tmp_path, '[daemon]\nstate_dir = "state"\n').with_state_dir(tmp_path / "other")
    assert config.state_dir == tmp_path / "other"


def test_a_file_is_no_state_dir(tmp_path) -> None:
    file = tmp_path / "notes"
    file.touch()
    with pytest.raises(ConfigError, match=r"notes: is a file, .* Give a folder with --state-dir"):
        load(tmp_path).with_state_dir(file)


LINE = ROBOT.count("\n")  # the tables appended begin on the next line


@pytest.mark.parametrize(
    ("tables", "line", "said"),
    [
        ("[daemn]\n", 1, "unknown table [daemn]. Did you mean 'daemon'?"),
        ("[daemon]\nmin_stepdeg = 1\n", 2, "unknown key 'min_stepdeg' in [daemon]. Did you mean 'min_step_deg'?"),
        ("[learner]\n\nsteps = 3\n", 3, "unknown key 'steps' in [learner]"),
        ("[drivers]\nport = 1\n", 2, "unknown key 'port' in [drivers]"),
        ("[vision]\ncolor = 'red'\n", 2, "unknown key 'color' in [vision]. Did you mean 'colour'?"),
        ("[sim]\nsede = 1\n", 2, "unknown key 'sede' in [sim]. Did you mean 'seed'?"),
        ("[vision.colour]\nhue_deg = 3\nhues = 1\n", 3, "unknown key 'hues' in [vision.colour]"),
        ("[daemon]\nmin_step_deg = 'one'\n", 2, "daemon.min_step_deg: expected `float`, got `str`"),
        ("[daemon]\nmin_step_deg = -1\n", 2, "daemon.min_step_deg: expected `float` > 0"),
        ("[daemon]\nmin_step_deg = 4\n", 2, "min_step_deg is not below max_step_deg"),
        ("[zenoh]\nsampler = '7447'\n", 2, "zenoh.sampler: '7447' is no endpoint. Write one like tcp/127.0.0.1:7447"),
        ("[zenoh]\nlearner = 'tcp/127.0.0.1'\n", 2, "zenoh.learner: 'tcp/127.0.0.1' is no endpoint"),
        ("[zenoh]\nlearner = 'tcp/127.0.0.1:65536'\n", 2, "zenoh.learner: 'tcp/127.0.0.1:65536' is no endpoint"),
        ("[zenoh]\nlearner = 'tcp/127.0.0.1:0'\n", 2, "zenoh.learner: 'tcp/127.0.0.1:0' is no endpoint"),
        ("[zenoh]\nlearner = 'tcp/127.0.0.1:7447'\n", 2, "sampler and learner have the same endpoint"),
        ("[daemon]\nmax_step_deg = inf\n", 2, "daemon.max_step_deg: not a finite number"),
        ("[sim.encoders]\n\nnoise_ticks = nan\n", 3, "sim.encoders.noise_ticks: not a finite number"),
        ("[daemon]\nmin_step_deg = = 1\n", 2, "not TOML"),
    ],
)
def test_a_mistake_is_named_with_its_line(tmp_path, tables, line, said) -> None:
    with pytest.raises(ConfigError) as refusal:
        load(tmp_path, tables)
    assert str(refusal.value).startswith(f"{tmp_path / 'robot.toml'}, line {LINE + line}: ")
    assert said in str(refusal.value)


def test_a_mistake_in_the_environment_is_named(tmp_path) -> None:
    with pytest.raises(ConfigError, match="variable BODYSCHEMA_DAEMON_MIN_STEP_DEG: expected `float`, got `str`"):
        load(tmp_path, environment={"BODYSCHEMA_DAEMON_MIN_STEP_DEG": "little"})


def test_an_unknown_key_in_the_environment_is_refused(tmp_path) -> None:
    with pytest.raises(ConfigError, match=r"BODYSCHEMA_DAEMON_MIN_STEP: unknown key 'min_step' in \[daemon\]"):
        load(tmp_path, environment={"BODYSCHEMA_DAEMON_MIN_STEP": "1"})


def test_missing_file_error_names_init_command(tmp_path) -> None:
    with pytest.raises(ConfigError, match=r"there is no such file\. `bodyschema init` writes one"):
        Config.load(tmp_path / "robot.toml", {})


def test_a_missing_table_is_named(tmp_path) -> None:
    (tmp_path / "robot.toml").write_text("[camera]\n")
    with pytest.raises(ConfigError, match=r"the table \[robot\] is missing"):
        Config.load(tmp_path / "robot.toml", {})


@pytest.mark.parametrize(
    ("key", "value", "said"),
    [
        ("camera.rpy", "[-90, 0, 90]", r"line \d+: camera.rpy = \[-90.0, 0.0, 90.0\]: this looks like degrees"),
        ("robot.marker_xyz", "[0, 0, 30]", r"line \d+: robot.marker_xyz = \[0.0, 0.0, 30.0\]: this looks like millim"),
        ("camera.xyz", "[1100, 0, 300]", r"line \d+: camera.xyz = \[1100.0, 0.0, 300.0\]: this looks like millim"),
        ("vision.radius_m", "20", r"line \d+: vision.radius_m = 20: this looks like millimetres. Give metres"),
        ("robot.name", '"my arm"', r"line \d+: robot.name: 'my arm' is no name .* Take letters, digits"),
    ],
)
def test_value_in_wrong_unit_is_rejected_with_line(tmp_path, key: str, value: str, said: str) -> None:
    file = write_small_arm(tmp_path, "[vision]\n")
    table, name = key.split(".")
    text = file.read_text().replace('name = "arm"\n', "") if name == "name" else file.read_text()
    file.write_text(text.replace(f"[{table}]\n", f"[{table}]\n{name} = {value}\n"))
    with pytest.raises(ConfigError, match=said):
        Config.load(file, {})


def test_distant_camera_is_not_mistaken_for_millimetres(tmp_path) -> None:
    file = write_small_arm(tmp_path)
    file.write_text(file.read_text().replace("[camera]\n", "[camera]\nxyz = [8.0, -6.0, 1.5]\n"))
    assert Config.load(file, {}).robot.camera.xyz == (8.0, -6.0, 1.5)


ONE_EYE = "eyes = 1\nfocal_px = 600.0\nprincipal_point_px = [319.5, 239.5]\nimage_size_px = [640, 480]\n"


def test_single_camera_calibration_has_no_baseline(tmp_path) -> None:
    calibration = load(tmp_path, f"{ONE_EYE}[vision]\nradius_m = 0.02\n").robot.calibration
    assert calibration is not None
    assert not calibration.is_stereo


@pytest.mark.parametrize(
    ("tables", "said"),
    [
        (ONE_EYE, r"vision\.radius_m is missing: one camera alone takes the depth from the marker's size"),
        (f'{ONE_EYE}[vision]\nmarker = "tag"\n', r"vision\.tag\.side_m is missing.*black square"),
        (
            f'{ONE_EYE}[vision]\nmarker = "cluster"\n[[vision.cluster.tags]]\nid = 1\n',
            r"vision\.tag\.side_m is missing",
        ),
        (f"{ONE_EYE}baseline_m = 0.1\n", r"one eye alone has no baseline_m"),
        (ONE_EYE.replace("eyes = 1\n", ""), r"baseline_m missing.*eyes = 1"),
        (
            '[vision.cameras.one]\ndevice = "/dev/v4l/by-id/usb-A-video-index0"\nimage_size_px = [640, 480]\n',
            r"vision\.radius_m is missing",
        ),
    ],
)
def test_missing_or_wrong_single_camera_setting_is_named(tmp_path, tables, said) -> None:
    with pytest.raises((ConfigError, RobotError), match=said):
        load(tmp_path, tables)
