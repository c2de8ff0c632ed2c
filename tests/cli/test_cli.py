from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
import warm
from cyclopts import CycloptsError
from small_arm import URDF, write_small_arm

from bodyschema.cli.commands.options import print_json
from bodyschema.cli.front_page import ASCII, UNICODE, front_page
from bodyschema.cli.main import COMMANDS, MODULES, RENAMED, app, command_line, present_names
from bodyschema.cli.terminal.screen import two_digits
from bodyschema.daemon.client_config import ClientConfig
from bodyschema.daemon.config import Config
from bodyschema.interfaces.errors import BusError, ConfigError, RequestError

LIMIT_S = 500.0


def run(*arguments: object, cwd: Path, environment: dict[str, str] | None = None) -> subprocess.CompletedProcess[str]:
    return warm.run("-m", "bodyschema", *arguments, cwd=cwd, env=os.environ | (environment or {}))


def called(*arguments: object) -> None:
    app(list(map(str, arguments)), exit_on_error=False, result_action="return_value")


@pytest.fixture
def robot(tmp_path: Path, free_endpoint) -> Path:
    return write_small_arm(
        tmp_path,
        f'[zenoh]\nsampler = "{free_endpoint()}"\nlearner = "{free_endpoint()}"\n[daemon]\nstate_dir = "state"\n',
    )


# All of robot.toml is checked only where nothing answers.
AS_IF_ANSWERED = "from bodyschema.daemon.client_config import ClientConfig; ClientConfig.fault = lambda _: ''"


def loaded_by(*lines: list[str], cwd: Path, first: str = "") -> set[str]:
    """Return the modules that a process has imported after running `first` and these command lines."""
    code = (
        first
        + """
import json, sys
from bodyschema.cli.main import main
for words in json.loads(sys.argv[1]):
    sys.argv[1:] = words
    try:
        main()
    except SystemExit:
        pass
print(*sys.modules)
"""
    )
    done = subprocess.run(
        [sys.executable, "-c", code, json.dumps(lines)],
        capture_output=True, text=True, timeout=LIMIT_S, check=True, cwd=cwd,
    )  # fmt: skip
    return set(done.stdout.splitlines()[-1].split())


def test_help_loads_nothing_that_takes_long(tmp_path) -> None:
    loaded = loaded_by(["--help"], cwd=tmp_path)
    assert "bodyschema.cli.front_page" in loaded
    assert loaded & {"cyclopts", "rich", "attr", "numpy", "zenoh", "msgspec", "ctypes", "inspect"} == set()
    assert len(loaded) < 100


def test_no_command_loads_numpy_before_it_runs(tmp_path) -> None:
    loaded = loaded_by(cwd=tmp_path, first=f"import {', '.join(MODULES.values())}")
    assert {"cyclopts", "bodyschema.cli.commands.calibrate.compare"} <= loaded
    assert loaded & {"numpy", "scipy", "kbmaps", "zenoh", "lxml"} == set()


def test_status_and_predict_load_no_numpy(robot) -> None:
    loaded = loaded_by(["status"], ["predict", "0", "0"], cwd=robot.parent, first=AS_IF_ANSWERED)
    assert {"bodyschema.daemon.client_config", "zenoh"} <= loaded
    assert loaded & {"numpy", "scipy", "kbmaps", "lxml", "tomlkit", "bodyschema.daemon.config"} == set()


def test_wrong_request_error_also_reports_toml_fault(robot) -> None:
    robot.write_text(robot.read_text() + "[daemon.more]\n")
    with pytest.raises(RequestError, match=r"has 1 numbers.* unknown key 'more'"):
        app(["predict", "0", "--robot", str(robot)], exit_on_error=False, result_action="return_value")


@pytest.mark.parametrize("words", ["status", "predict 0 0", "ik 0.1 0.2 0.3", "command pause"])
@pytest.mark.parametrize(("missing", "fault"), [(True, "cannot read the URDF"), (False, "unknown key 'radius'")])
def test_silent_daemon_is_reported_before_toml_fault(robot, capsys, words, missing, fault) -> None:
    """A client's machine need not have every file that robot.toml names."""
    if missing:
        robot.with_name("arm.urdf").unlink()
    else:
        robot.write_text(robot.read_text() + "[vision]\nradius = 1\n")
    with pytest.raises(BusError) as raised:
        called(*words.split(), "--robot", robot)
    silence, cause = f"{capsys.readouterr().out}{raised.value}".split("cannot start on this machine: ")
    assert "nothing listens on" in silence or "learner does not answer" in silence
    assert fault in cause


def test_error_message_truncates_a_very_long_key(robot) -> None:
    robot.write_text(robot.read_text() + f'["{"a=." * 100_000}"]\n')
    said = run("config", cwd=robot.parent).stderr
    assert "unknown table [a=.a=." in said
    assert len(said) < 5000


def test_a_client_config_agrees_with_the_whole(robot, monkeypatch) -> None:
    whole, own = Config.load(robot, {}), ClientConfig.load(robot, {})
    assert (own.name, own.joints, own.zenoh) == (whole.robot.name, whole.robot.joints, whole.tables.zenoh)
    assert own.route("learner") == whole.route("learner")
    assert own.slides == tuple(whole.robot.chain.prismatic.tolist())
    limits = [(own.joint_limits[name][1:]) for name in own.joints]
    assert limits == list(zip(whole.robot.lower.tolist(), whole.robot.upper.tolist(), strict=True))
    renamed = ClientConfig.load(robot, {"BODYSCHEMA_ROBOT_NAME": "other", "BODYSCHEMA_ROBOT": str(robot)})
    assert renamed.name == "other"


@pytest.mark.parametrize("first", ['<!DOCTYPE robot [<!ENTITY a "b">]>', '<?xml version="1.0" encoding="foo"?>'])
def test_client_config_reads_urdf_as_strictly_as_config(robot, first) -> None:
    own = ClientConfig.load(robot, {})
    urdf = own.urdf
    urdf.write_text(first + re.sub(r"<\?xml.*?\?>", "", urdf.read_text()).strip())
    with pytest.raises(ConfigError):
        assert own.slides


def test_status_and_predict_load_neither_effects_nor_solvers(robot) -> None:
    loaded = loaded_by(["status"], ["predict", "0", "0"], cwd=robot.parent, first=AS_IF_ANSWERED)
    assert {"bodyschema.cli.commands.run.status", "bodyschema.cli.commands.run.predict", "zenoh"} <= loaded
    heavy = {
        "bodyschema.effects",
        "kbmaps.chains.parameters",
        "scipy",
        "cv2",
        "serial",
        "rich.live",
        "importlib.metadata",
    }
    assert loaded & heavy == set()
    assert len(loaded) < 500


@pytest.mark.parametrize("width", [40, 80])
def test_the_front_page_is_the_command_line_s(width, capsys, monkeypatch) -> None:
    monkeypatch.setenv("COLUMNS", str(width))
    command_line()(["--help"], exit_on_error=False, result_action="return_value")
    shown = [line.rstrip() for line in capsys.readouterr().out.splitlines()]
    assert [line.rstrip() for line in front_page(width).splitlines()] == shown


def test_colours_and_ascii_keep_the_front_page_wording() -> None:
    plain = front_page(80)
    assert re.sub(r"\x1b\[\d+m", "", front_page(80, colour=True)) == plain
    assert front_page(80, signs=ASCII) == plain.translate(str.maketrans(UNICODE, ASCII))


def test_help_names_every_command(tmp_path) -> None:
    text = run("--help", cwd=tmp_path).stdout
    assert [name for name in COMMANDS if f" {name} " not in text] == []


@pytest.mark.parametrize(
    "command", [*COMMANDS, "calibrate cameras", "calibrate latency", "marker print", "marker learn"]
)
def test_each_help_page_states_needs_and_next_step(command, capsys) -> None:
    # As in a process of its own: a summary given to the same page before would be shown in its place.
    sys.modules.pop(MODULES[command.split()[0]], None)
    command_line(command.split()[0])([*command.split(), "--help"], exit_on_error=False, result_action="return_value")
    page = capsys.readouterr().out
    beginnings = [line.split(" ")[0] for line in page.splitlines()]
    assert ("Needs:" in beginnings, "Next:" in beginnings) == (True, True)
    assert "--empty-" not in page


def test_help_fits_a_terminal_of_80_columns(tmp_path) -> None:
    lines = run("--help", cwd=tmp_path, environment={"COLUMNS": "80"}).stdout.splitlines()
    assert max(map(len, lines)) <= 80
    assert len([line for line in lines if line.startswith("│")]) == len(COMMANDS) + len(("--help", "--version"))


def test_user_error_prints_one_line_and_exits_1(tmp_path) -> None:
    done = run("run", "sampler", cwd=tmp_path)
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr == "bodyschema: robot.toml: there is no such file. `bodyschema init` writes one\n"


def test_robot_toml_may_be_named_in_the_environment(tmp_path, robot) -> None:
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    done = run("config", cwd=elsewhere, environment={"BODYSCHEMA_ROBOT": str(robot)})
    assert done.returncode == 0, done.stderr


# --- config


def test_init_example_is_valid_once_the_urdf_fits(tmp_path, capsys) -> None:
    called("init", "--robot", tmp_path / "robot.toml")
    urdf = URDF.replace("waist", "joint_1").replace("shoulder", "joint_2").replace('"base"', '"base_link"')
    (tmp_path / "my_robot.urdf").write_text(urdf)
    called("config", "--robot", tmp_path / "robot.toml")
    assert "is in order: robot my_robot, 2 joints" in capsys.readouterr().out


def test_init_fills_robot_toml_from_the_urdf(tmp_path) -> None:
    write_small_arm(tmp_path)
    called("init", "--robot", tmp_path / "new.toml", "--urdf", tmp_path / "arm.urdf")
    robot = Config.load(tmp_path / "new.toml", {}).robot
    assert (robot.name, robot.joints, robot.robot.marker_link) == ("arm", ("waist", "shoulder"), "hand")


def test_init_with_sim_leaves_nothing_to_correct(tmp_path) -> None:
    called("init", "--sim", "--robot", tmp_path / "robot.toml")
    assert Config.load(tmp_path / "robot.toml", {}).robot.calibration is not None


def test_init_replaces_no_file(robot) -> None:
    before = robot.read_text()
    with pytest.raises(ConfigError, match=r"is there already\. Give another --robot"):
        called("init", "--robot", robot)
    assert robot.read_text() == before


def test_init_says_when_it_cannot_write(tmp_path) -> None:
    with pytest.raises(ConfigError, match="cannot be written: No such file or directory"):
        called("init", "--robot", tmp_path / "nowhere" / "robot.toml")


GRIPPER = """
  <link name="finger_a"/><link name="finger_b"/>
  <joint name="gripper" type="revolute">
    <parent link="hand"/><child link="finger_a"/><limit lower="0" upper="1" effort="1" velocity="1"/>
  </joint>
  <joint name="other" type="revolute">
    <parent link="hand"/><child link="finger_b"/><limit lower="0" upper="1" effort="1" velocity="1"/>
    <mimic joint="gripper"/>
  </joint>
</robot>"""


def test_init_leaves_out_gripper_and_mimic_joints(tmp_path) -> None:
    write_small_arm(tmp_path)
    urdf = tmp_path / "arm.urdf"
    urdf.write_text(urdf.read_text().replace("</robot>", GRIPPER))
    called("init", "--robot", tmp_path / "new.toml", "--urdf", urdf)
    robot = Config.load(tmp_path / "new.toml", {}).robot
    assert (robot.joints, robot.robot.marker_link) == (("waist", "shoulder"), "hand")


def test_init_takes_the_links_that_are_given(tmp_path) -> None:
    write_small_arm(tmp_path)
    links = "--marker-link", "upper", "--camera-link", "base"
    called("init", "--robot", tmp_path / "new.toml", "--urdf", tmp_path / "arm.urdf", *links)
    robot = Config.load(tmp_path / "new.toml", {}).robot
    assert (robot.joints, robot.robot.marker_link, robot.camera.parent_link) == (("waist",), "upper", "base")


def test_init_refuses_a_link_absent_from_urdf(tmp_path) -> None:
    write_small_arm(tmp_path)
    with pytest.raises(ConfigError, match=r"has no link 'hnad'\. Did you mean 'hand'"):
        called("init", "--robot", tmp_path / "new.toml", "--urdf", tmp_path / "arm.urdf", "--marker-link", "hnad")


def test_init_refuses_a_urdf_in_which_nothing_moves(tmp_path) -> None:
    (tmp_path / "arm.urdf").write_text('<robot name="x"><link name="a"/></robot>')
    with pytest.raises(ConfigError, match="no joint moves"):
        called("init", "--robot", tmp_path / "new.toml", "--urdf", tmp_path / "arm.urdf")
    assert not (tmp_path / "new.toml").exists()


@pytest.mark.parametrize("present", RENAMED.values(), ids=" ".join)
def test_renamed_commands_exist_under_the_present_name(present, capsys) -> None:
    command_line(present[0])([*present, "--help"], exit_on_error=False, result_action="return_value")
    page = capsys.readouterr().out
    assert f"Usage: bodyschema {present[0]}" in page
    assert all(word in page for word in present)


def test_every_output_for_programs_has_a_schema(capsys) -> None:
    print_json({"pairs": 3})
    assert json.loads(capsys.readouterr().out) == {"schema": 1, "pairs": 3}
    print_json({"schema": 2, "pairs": 3})
    assert json.loads(capsys.readouterr().out)["schema"] == 2


def test_options_that_belong_to_another_process_are_refused(robot) -> None:
    with pytest.raises(RequestError, match="--sim does not go with `bodyschema run learner`"):
        called("run", "learner", "--sim", "--robot", robot)
    with pytest.raises(RequestError, match="--compare"):
        called("fleet", "a.csv", "--compare")


def test_the_earlier_names_answer_with_the_present_one(capsys) -> None:
    assert present_names(["servos", "set", "id=3"]) == ["servos", "id=3"]
    assert present_names(["fleet", "a.csv"]) == ["fleet", "a.csv"]
    assert present_names(["robot", "new", "--urdf", "a"]) == ["init", "--from", "scan", "--urdf", "a"]
    assert present_names(["config", "init", "--sim"]) == ["init", "--sim"]
    assert present_names(["bench", "--port", "./bus"]) == ["emulate", "--port", "./bus"]
    assert "bodyschema config init is now: bodyschema init\n" in capsys.readouterr().err


def test_check_prints_joint_ranges_and_calibration_state(robot, capsys) -> None:
    called("config", "--robot", robot)
    text = capsys.readouterr().out
    assert "waist: -171.9° to 171.9°" in text
    assert "stereo calibration not described" in text


def test_show_prints_the_settings_in_force(tmp_path, robot, capsys, monkeypatch) -> None:
    monkeypatch.setenv("BODYSCHEMA_DAEMON_MAX_STEP_DEG", "8")
    called("config", "--json", "--robot", robot)
    shown = json.loads(capsys.readouterr().out)
    assert (shown["schema"], shown["daemon"]["max_step_deg"]) == (1, 8.0)
    assert shown["robot"]["marker_xyz"] == [0.0, 0.0, 0.0]


def test_the_written_example_explains_every_key_in_place(tmp_path) -> None:
    called("init", "--robot", tmp_path / "robot.toml")
    text = (tmp_path / "robot.toml").read_text()
    assert tomllib.loads(text)["robot"]["marker_known"] is False
    assert text.count("CHECK") >= 4


# --- processes that are not there


def test_unanswered_command_names_the_daemon_to_start(robot) -> None:
    with pytest.raises(
        BusError, match=r"nothing listens on tcp/127\.0\.0\.1:[0-9]+\. Start the daemon with `bodyschema run`"
    ):
        called("command", "pause", "--robot", robot)


def test_an_unknown_command_lists_the_known_ones(tmp_path, robot) -> None:
    done = run("command", "dance", "--robot", robot, cwd=tmp_path)
    assert done.returncode > 0
    assert "tool_changed" in done.stdout + done.stderr


def test_sampler_without_driver_fails_and_leaves_no_store(tmp_path, robot) -> None:
    done = run("run", "sampler", "--robot", robot, cwd=tmp_path)
    assert (done.returncode, "no driver is configured" in done.stderr) == (1, True)
    assert not (tmp_path / "state").exists()


@pytest.mark.parametrize(
    ("value", "shown"), [(0.031, "0.031"), (0.5, "0.50"), (1.96, "2.0"), (123.4, "123"), (0.0, "0")]
)
def test_small_sigma_is_shown_with_two_digits(value: float, shown: str) -> None:
    assert two_digits(value) == shown


def test_a_demo_of_no_pairs_is_refused() -> None:
    with pytest.raises(CycloptsError, match="--pairs"):
        app(["demo", "--pairs", "-1"], exit_on_error=False, print_error=False)


@pytest.mark.parametrize("option", [("--sigma-mm", "1e308"), ("--marker-delay-ms", "nan")])
def test_impossible_option_values_are_refused_before_reading(option) -> None:
    with pytest.raises(CycloptsError, match=option[0]):
        called("calibrate", "a.csv", *option)
