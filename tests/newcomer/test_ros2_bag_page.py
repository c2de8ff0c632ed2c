"""The commands of docs/ros2_bag.md, typed as printed, with the bags of examples/desk_arm."""

from __future__ import annotations

import re
import runpy
import shutil
from pathlib import Path

import numpy as np
import pytest

from bodyschema.interfaces.errors import RecordingError

pytest.importorskip("rosbags")
from typed_pages import DOCS, TypedPage, command_of, commands_of, expected_mm

PAGE = (DOCS / "ros2_bag.md").read_text(encoding="utf-8")
DESK_ARM = DOCS.parent / "examples" / "desk_arm"
COMMANDS = commands_of(PAGE)


@pytest.mark.parametrize("command", COMMANDS)
def test_commands_are_understood(command: str) -> None:
    assert command_of(command).startswith("bodyschema.cli.commands.")  # not that of a help page


def test_a_new_bag_is_predicted_to_the_noise(tmp_path, monkeypatch, capsys) -> None:
    page = TypedPage(PAGE, capsys)
    shutil.copy(DESK_ARM / "desk_arm.urdf", tmp_path)
    monkeypatch.chdir(tmp_path)
    runpy.run_path(str(DESK_ARM / "bags.py"))

    init, asked, calibrate, export, simulate, compare = COMMANDS
    assert page.type(init) == page.shown(init)
    with pytest.raises(RecordingError) as unclear:
        page.type(asked)
    assert f"bodyschema: {unclear.value}\n" == page.shown(asked)

    calibrated = page.type(calibrate)
    assert expected_mm(calibrated) == pytest.approx(expected_mm(page.shown(calibrate)), rel=0.01)
    assert transform(calibrated) == pytest.approx(transform(page.shown(calibrate)), abs=1e-6)
    assert Path("calibrated/hand_eye.launch.py").exists()

    for command in (export, simulate):
        assert page.type(command).strip() in PAGE
    assert rms(page.type(compare)) == pytest.approx(rms(PAGE), abs=0.002)


def transform(text: str) -> list[float]:
    return [float(value) for value in re.findall(r"--q?[xyzw] (\S+)", text)]


def rms(text: str) -> np.ndarray:
    line = re.search(r"^RMS \[mm\] +([\d.]+) +([\d.]+) +([\d.]+)", text, re.MULTILINE)
    assert line is not None, text
    return np.array(list(map(float, line.groups())))
