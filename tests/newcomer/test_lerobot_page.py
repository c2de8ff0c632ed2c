"""The commands of docs/lerobot.md, typed as printed, on an SO-101 emulated at the byte level."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from so101_on_a_port import So101
from typed_pages import DOCS, TypedPage, command_of, commands_of, expected_mm

from bodyschema.daemon.config import Config
from bodyschema.robot.lerobot import read_calibration
from bodyschema.robot.urdf import chain_between

PAGE = (DOCS / "lerobot.md").read_text(encoding="utf-8")
SO101 = DOCS.parent / "examples" / "so101"
ROWS = 300
TRUST, AGAIN = (f"bodyschema calibrate {name}.csv --trust-urdf" for name in ("so101", "again"))
INIT, SIMULATE, EXPORT, DIFFERENCE, WRITE, SIMULATE_AGAIN, CORRECT_URDF = (
    next(command for command in commands_of(PAGE) if re.search(word, command))
    for word in (
        r"init .*\./bus$",
        "simulate",
        "--markers",
        r"\.json$",
        r"\.json --write",
        "mended.toml",
        "--out calibrated",
    )
)


@pytest.fixture
def page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> TypedPage:
    """Return the page, with the example's files in the working directory and a robot.toml."""
    shutil.copytree(SO101, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    return TypedPage(PAGE, capsys)


@pytest.mark.parametrize("command", commands_of(PAGE))
def test_commands_are_understood(command: str) -> None:
    assert command_of(command).startswith("bodyschema.cli.commands.")  # not that of a help page


@pytest.mark.soak  # without its servos: the test below
def test_offsets_go_into_the_servos_and_errors_fall(page: TypedPage) -> None:
    assert page.type(INIT) == page.shown(INIT)
    config = Config.load(Path("robot.toml"), {})
    arm = So101(config.robot, read_calibration(Path("follower.json")), (0.0, 2.5, -3.0, 1.5, 0.0), seed=1)
    arm.record(config, ROWS).write_csv(Path("so101.csv"))

    before = expected_mm(page.type(TRUST))
    assert offsets(page.type(DIFFERENCE)) == pytest.approx(offsets(page.shown(DIFFERENCE)), abs=10)
    page.type(WRITE)

    arm.give(read_calibration(Path("follower.json"))).record(config, ROWS).write_csv(Path("again.csv"))
    after = expected_mm(page.type(AGAIN))
    assert after[0] < before[0] / 2


def test_without_an_arm_every_number_is_the_page_s(page: TypedPage) -> None:
    assert page.type(INIT) == page.shown(INIT)
    assert page.type(SIMULATE) == page.shown(SIMULATE)
    before = expected_mm(page.type(TRUST))
    assert before == expected_mm(page.shown(TRUST))
    lines = page.type(DIFFERENCE).splitlines()
    assert [line for line in page.shown(DIFFERENCE).splitlines() if line != "…" and line not in lines] == []
    page.type(WRITE)
    exec(Path("mended.py").read_text(), {})
    assert page.type(SIMULATE_AGAIN) == page.shown(SIMULATE_AGAIN)
    after = expected_mm(page.type(AGAIN))
    assert after == expected_mm(page.shown(AGAIN))
    assert after[0] < before[0] / 2


def hand(robot: str, q: np.ndarray) -> np.ndarray:
    """Return where the URDF of a robot.toml has gripper_frame_link in base_link (n, 3) [m]."""
    found, ends = Config.load(Path(robot), {}).robot, {"start": "base_link", "end": "gripper_frame_link"}
    chain = chain_between(found.tree, found.joints, {}, **ends, T_start_camera=np.eye(4), marker_xyz=np.zeros(3))
    return chain.positions(q)


def test_the_corrected_urdf_takes_the_worn_arm_s_readings(page: TypedPage) -> None:
    page.type(INIT)
    page.type(SIMULATE)
    page.type(CORRECT_URDF)
    q = np.random.default_rng(0).uniform(-0.8, 0.8, (100, 5))
    true = hand("robot.toml", q + np.array([0.0, 0.0436, -0.0524, 0.0262, 0.0]))
    off = np.linalg.norm(hand("calibrated/robot.toml", q) - true, axis=1)
    assert off.max() < 3e-4


def offsets(text: str) -> list[int]:
    """Return the new homing offsets of a difference, modulo a turn."""
    return [int(number) % 4096 for number in re.findall(r"homing_offset -?\d+ → (-?\d+)", text)]


def test_a_dataset_gives_the_same_joints(page: TypedPage) -> None:
    pytest.importorskip("pyarrow")
    from lerobot_datasets import write_dataset

    page.type(INIT)
    motors = read_calibration(Path("follower.json"))
    t = np.arange(0, 4, 1 / 30)
    q = np.sin(np.outer(t, [0.5, 0.7, 0.9, 1.1, 1.3, 0.2]))
    write_dataset(Path("my_dataset"), "v3.0", "degrees", motors, [(t, q)])
    chain = Config.load(Path("robot.toml"), {}).robot.chain
    rows = np.column_stack([t, chain.positions(q[:, :5])])[5:-5]
    np.savetxt("tag.csv", rows, fmt="%.9f", delimiter=",", header="t,x,y,z", comments="")
    assert page.type(EXPORT) == "110 samples written to so101.csv\n"
    read = np.loadtxt("so101.csv", delimiter=",", skiprows=1, usecols=range(2, 7))
    assert read == pytest.approx(q[5:-5, :5], abs=1e-6)
