"""The commands of docs/own_robot.md, typed as printed."""

from __future__ import annotations

import json
import re
import shlex
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
import warm
from scipy.spatial.transform import Rotation
from typed_pages import command_of

from bodyschema.daemon.config import Config
from bodyschema.interfaces.errors import BodyschemaError
from bodyschema.recordings.recording import Recording
from bodyschema.robot.description import CameraSection, RobotDescription
from kbmaps import RigidChain

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "own_robot.md").read_text(encoding="utf-8")
EXAMPLE = ROOT / "examples" / "desk_arm"
STEP_RAD = np.radians(2.0)
MORE_MISTAKES = [
    (
        'urdf = "desk_arm.urdf"',
        'urdf = "desk_arm.xacro"',
        "desk_arm.xacro: cannot read the URDF: No such file or directory. Fix [robot] urdf, or --urdf. "
        "It is named by robot.urdf in robot.toml, line 4",
    ),
    (
        'marker_link = "gripper"',
        'marker_link = "hand"',
        "robot.toml, line 6: there is no link 'hand' in desk_arm.urdf. "
        "Known are: base_link, turret, upper_arm, forearm, wrist, gripper",
    ),
    ("[0.0, 0.0, 0.03]", "[0.0, 0.03]", "robot.toml, line 7: robot.marker_xyz: expected array of length 3, got 2"),
    (
        "baseline_m = 0.20",
        "# baseline_m = 0.09",
        "robot.toml, line 11: the stereo camera is described in part: baseline_m missing. "
        "Give all or none; a camera without a second one is eyes = 1",
    ),
    ("pose_known = false", 'pose_known = "no"', "robot.toml, line 15: camera.pose_known: expected bool, got str"),
    (
        "[0.0, 0.0, 0.03]",
        "[0, 0, 30]",
        "robot.toml, line 7: robot.marker_xyz = [0.0, 0.0, 30.0]: this looks like millimetres. Give metres",
    ),
    (
        "radius_m = 0.020",
        "radius_m = 20",
        "robot.toml, line 23: vision.radius_m = 20: this looks like millimetres. Give metres",
    ),
    (
        '"desk_arm"',
        '"my arm"',
        "robot.toml, line 3: robot.name: 'my arm' is no name for zenoh keys. "
        "Take letters, digits, _ . and -, without spaces, and begin with a letter, a digit or _",
    ),
    ("[vision]", "[visoin]", "robot.toml, line 21: unknown table [visoin]. Did you mean 'vision'?"),
]  # right, wrong, message
COMMANDS = re.findall(r"^\$ (bodyschema .*)$", PAGE, re.MULTILINE)


def output_of(command: str) -> str:
    """Return the output that the page shows for a command."""
    return re.search(rf"```console\n\$ {re.escape(command)}\n(.*?)```", PAGE, re.DOTALL)[1]


def table(heading: str) -> list[list[str]]:
    """Return the rows of the table whose first column has this heading."""
    body = re.search(rf"^\| {re.escape(heading)} \|.*\n\| ---.*\n((?:\|.*\n)+)", PAGE, re.MULTILINE)[1]
    return [[cell.strip() for cell in line.split(" | ")] for line in re.findall(r"^\| (.*) \|$", body, re.MULTILINE)]


def code(cell: str) -> str:
    return cell.strip("`")


@pytest.fixture
def desk(tmp_path: Path) -> Path:
    """Return a folder of the user's own with the example in it."""
    return Path(shutil.copytree(EXAMPLE, tmp_path / "desk_arm"))


def typed(command: str, folder: Path) -> subprocess.CompletedProcess[str]:
    environment = {"XDG_STATE_HOME": "/home/you/.local/state", "PATH": "/usr/bin:/bin", "OPENBLAS_NUM_THREADS": "1"}
    return warm.run("-m", "bodyschema", *shlex.split(command)[1:], cwd=folder, env=environment)


def test_the_page_shows_the_example_s_robot_toml() -> None:
    shown = re.search(r"```toml\n(.*?)```", PAGE, re.DOTALL)[1]
    assert shown == (EXAMPLE / "robot.toml").read_text(encoding="utf-8")


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_on_the_page_is_understood(command: str) -> None:
    assert command_of(command).startswith("bodyschema.cli.commands.")  # not that of a help page


def test_init_writes_documented_example_robot_toml(desk) -> None:
    (desk / "robot.toml").unlink()
    command = "bodyschema init --urdf desk_arm.urdf"
    assert typed(command, desk).stdout == output_of(command)
    guessed, example = Config.load(desk / "robot.toml", {}).robot, Config.load(EXAMPLE / "robot.toml", {}).robot
    assert (guessed.joints, guessed.robot.marker_link) == (example.joints, example.robot.marker_link)


def test_check_prints_what_the_page_says(desk) -> None:
    assert typed("bodyschema config", desk).stdout == output_of("bodyschema config")


def test_check_names_a_joint_that_was_forgotten(desk) -> None:
    text = (desk / "robot.toml").read_text(encoding="utf-8")
    (desk / "robot.toml").write_text(text.replace('"base_yaw", ', ""), encoding="utf-8")
    assert "base_yaw: on the way, but not in joints: stands still at 0" in typed("bodyschema config", desk).stdout


@pytest.mark.parametrize(("right", "wrong", "message"), [*table("instead of"), *MORE_MISTAKES])
def test_a_mistake_in_robot_toml_gets_its_message(desk, right: str, wrong: str, message: str) -> None:
    file = desk / "robot.toml"
    text = file.read_text(encoding="utf-8")
    assert code(right) in text
    file.write_text(text.replace(code(right), code(wrong), 1), encoding="utf-8")
    with pytest.raises(BodyschemaError) as refused:
        Config.load(file, {})
    assert str(refused.value).replace(f"{desk}/", "").replace("`", "") == code(message)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        *table("row or heading"),
        ("0.1,nan,0.2,0.3,1,1,1", "line 2, column shoulder_pitch: nan is not a finite number. Fix or delete the row"),
    ],
)
def test_a_mistake_in_a_recording_gets_its_message(desk, line: str, message: str) -> None:
    robot = RobotDescription.load(desk / "robot.toml")
    heading = ",".join([*robot.joints, "x", "y", "z"])
    rows = [code(line), ""] if code(line)[0].isalpha() else [heading, code(line), ""]
    (desk / "mine.csv").write_text("\n".join(rows), encoding="utf-8")
    with pytest.raises(BodyschemaError) as refused:
        Recording.read(desk / "mine.csv", robot.joints)
    assert str(refused.value).replace(f"{desk}/mine.csv, ", "") == code(message)


AXES = {"+x": (1, 0, 0), "-x": (-1, 0, 0), "+y": (0, 1, 0), "-y": (0, -1, 0), "-z": (0, 0, -1)}


@pytest.mark.parametrize(("forward", "down", "rpy"), table("the camera looks along its link's"))
def test_the_page_s_orientations_look_where_it_says(forward: str, down: str, rpy: str) -> None:
    pose = CameraSection(parent_link="base", rpy=tuple(json.loads(code(rpy)))).pose
    assert pose[:3, 2] == pytest.approx(AXES[forward], abs=1e-4)
    assert pose[:3, 1] == pytest.approx(AXES[down], abs=1e-4)


def guided_recording(robot: RobotDescription, rows: int) -> str:
    """Return the CSV of a guided path of an arm that deviates from `robot`, with 0.5 mm of noise."""
    rng = np.random.default_rng(0)
    fixed = robot.chain.fixed.copy()
    for transform in fixed:
        transform[:3, :3] = transform[:3, :3] @ Rotation.from_rotvec(0.03 * rng.normal(size=3)).as_matrix()
        transform[:3, 3] += 0.01 * rng.normal(size=3)
    built = RigidChain(fixed, robot.chain.axes, robot.chain.prismatic)
    q, goal = [np.zeros(len(robot.joints))], rng.uniform(-1.2, 1.2, len(robot.joints))
    while len(q) < rows:
        way = goal - q[-1]
        q.append(q[-1] + STEP_RAD * way / np.linalg.norm(way))
        if np.linalg.norm(way) < 2 * STEP_RAD:
            goal = rng.uniform(-1.2, 1.2, len(robot.joints))
    x = built.positions(np.array(q)) + 5e-4 * rng.normal(size=(rows, 3))
    lines = [",".join(f"{value:.6f}" for value in row) for row in np.hstack([q, x])]
    return "\n".join([",".join([*robot.joints, "x", "y", "z"]), *lines, ""])


@pytest.mark.soak
def test_own_recording_replays_as_documented(desk) -> None:
    recording = guided_recording(RobotDescription.load(desk / "robot.toml"), 60)
    (desk / "guided.csv").write_text(recording, encoding="utf-8")
    done = typed("bodyschema replay guided.csv --speed 1", desk)
    assert done.returncode == 0, done.stderr
    shown, printed = output_of("bodyschema replay guided.csv").splitlines(), done.stdout.splitlines()
    assert [line.split("  ")[0] for line in printed[2:6]] == [line.split("  ")[0] for line in shown[2:6]]
