"""The commands and tables of docs/one_camera.md."""

from __future__ import annotations

import re
import shutil
import tomllib
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from typed_pages import DOCS, command_of

from bodyschema.cli.main import command_line

PAGE = (DOCS / "one_camera.md").read_text(encoding="utf-8")
CONSOLE = "\n".join(re.findall(r"```console\n(.*?)```", PAGE, re.DOTALL))
COMMANDS = [
    *re.findall(r"^(?:\.venv/bin/)?(bodyschema .*)$", CONSOLE, re.MULTILINE),
    *re.findall(r"`(bodyschema (?:init|marker print|calibrate) [^`]*[^` ])`", PAGE),
]
WEBCAM = "/dev/v4l/by-id/usb-046d_HD_Pro_Webcam_C920_46D3A1-video-index0"
EXAMPLES = DOCS.parent / "examples"
CAMERA_ON_TOOL = [30.0, -20.0, 50.0, 4.0, -3.0, 8.0]  # x, y, z [mm], roll, pitch, yaw [°]


def typed(words: str, capsys) -> str:
    """Type a command in the working directory and return what it prints."""
    arguments = words.split()[1:]
    capsys.readouterr()
    command_line(arguments[0])(arguments, exit_on_error=False, result_action="return_value")
    return capsys.readouterr().out


@pytest.fixture
def written(tmp_path: Path, monkeypatch, capsys) -> str:
    """Return the robot.toml of the page, without servos, in the working directory."""
    shutil.copy(EXAMPLES / "desk_arm" / "desk_arm.urdf", tmp_path / "my_robot.urdf")
    monkeypatch.chdir(tmp_path)
    typed(f"bodyschema init --urdf my_robot.urdf --webcam {WEBCAM} --tag-mm 49.8", capsys)
    return Path("robot.toml").read_text(encoding="utf-8")


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_on_the_page_is_understood(command: str) -> None:
    assert command_of(command).startswith("bodyschema.cli.commands.")


def test_the_readme_lists_the_demo_with_one_camera() -> None:
    assert ".venv/bin/bodyschema demo --camera mono\n" in (DOCS.parent / "README.md").read_text(encoding="utf-8")


def test_init_writes_the_tables_of_the_page(written) -> None:
    shown, found = tomllib.loads(re.findall(r"```toml\n(.*?)```", PAGE, re.DOTALL)[0]), tomllib.loads(written)
    assert found["vision"] == shown["vision"]
    assert {key: found["camera"][key] for key in shown["camera"]} == shown["camera"]


def test_init_writes_a_chessboard(written, capsys) -> None:
    typed("bodyschema init --urdf my_robot.urdf --robot other.toml --chessboard 8 5 29.9", capsys)
    vision = tomllib.loads(Path("other.toml").read_text(encoding="utf-8"))["vision"]
    assert vision == {"marker": "chessboard", "chessboard": {"columns": 8, "rows": 5, "square_m": 0.0299}}


def test_one_camera_has_no_left_eye(written) -> None:
    assert "left" not in written


def test_config_speaks_of_one_camera(written, capsys) -> None:
    text = Path("robot.toml").read_text(encoding="utf-8")
    Path("robot.toml").write_text(text.replace('calibration = "cameras.toml"', "# "), encoding="utf-8")
    told = typed("bodyschema config", capsys)
    assert "images of 640x480 pixels, 30 a second" in told
    assert "each eye" not in told


def tool_poses(rows: int, rng: np.random.Generator) -> str:
    """Return a CSV of tool poses and where a camera on the tool sees a marker, with 0.2 mm of noise."""
    mounted = np.eye(4)
    mounted[:3, :3] = Rotation.from_euler("xyz", CAMERA_ON_TOOL[3:], degrees=True).as_matrix()
    mounted[:3, 3] = 1e-3 * np.array(CAMERA_ON_TOOL[:3])
    marker = np.array([0.5, 0.05, 0.02, 1.0])
    lines = ["tool_x,tool_y,tool_z,tool_roll,tool_pitch,tool_yaw,x,y,z"]
    for _ in range(rows):
        place = marker[:3] + rng.uniform(-0.25, 0.25, 3) + [0.0, 0.0, 0.55]
        angles = np.array([np.pi, 0.0, 0.0]) + rng.uniform(-0.5, 0.5, 3)
        tool = np.eye(4)
        tool[:3, :3], tool[:3, 3] = Rotation.from_euler("xyz", angles).as_matrix(), place
        seen = (np.linalg.inv(tool @ mounted) @ marker)[:3] + 2e-4 * rng.standard_normal(3)
        lines.append(",".join(f"{value:.6f}" for value in (*place, *angles, *seen)))
    return "\n".join([*lines, ""])


def test_tool_poses_give_mounted_camera_pose(tmp_path, monkeypatch, capsys) -> None:
    shutil.copytree(EXAMPLES / "tool_poses", tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    Path("poses.csv").write_text(tool_poses(40, np.random.default_rng(0)), encoding="utf-8")
    told = typed("bodyschema calibrate poses.csv --trust-urdf", capsys)
    block = told[told.index("camera on tool") : told.index("marker on base_link")]
    found = [float(row[0]) for row in re.findall(r"([-+\d.]+) +± ([\d.]+)", block)]
    assert found == pytest.approx(CAMERA_ON_TOOL, abs=0.5)
