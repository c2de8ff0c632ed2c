"""docs/effects.md agrees with the code."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from effect_arms import arm, walk

from bodyschema.effects import EFFECT_TYPES, Simulation, Unexplained, load_simulation
from bodyschema.recordings.recording import Recording
from kbmaps import JointBasis, RigidChain

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs" / "effects.md").read_text(encoding="utf-8")
ROWS = dict(re.findall(r"^\| `(\w+)` \| (.*) \|$", PAGE, re.MULTILINE))


def block(language: str) -> str:
    found = re.search(rf"```{language}\n(.*?)```", PAGE, re.DOTALL)
    assert found is not None
    return found[1]


def test_page_has_a_row_for_every_effect_type() -> None:
    assert set(ROWS) == set(EFFECT_TYPES)


@pytest.mark.parametrize("name", list(EFFECT_TYPES))
def test_the_row_of_an_effect_names_its_numbers(name: str) -> None:
    numbers = set(re.findall(r"`([a-z0-9]+(?:_\w+)?)`", ROWS[name].split(" | ")[0]))
    names = [parameter.name for parameter in EFFECT_TYPES[name].turning]
    if " … " in ROWS[name]:
        names = [names[0], "rz_rad", *names[6:]]
    assert numbers - {"compliance_m_per_N", "width_m", "hold_N"} == set(names)


def test_the_page_s_extended_toml_can_be_read(tmp_path) -> None:
    robot = arm(tmp_path)
    bases = tuple(JointBasis.orthonormal(-1.5, 1.5) for _ in range(2))
    turn = RigidChain(np.tile(np.eye(4), (3, 1, 1)), np.eye(3)[:2], np.zeros(2, dtype=bool)).with_tool([0.01, 0, 0])
    (tmp_path / "unexplained.kbmap").write_bytes(turn.to_kbmap(bases).to_bytes())
    robot.file.write_text(robot.file.read_text() + block("toml").replace('"shoulder"', '"shoulder_lift"'))
    simulation = load_simulation(robot.file)
    assert [effect.name for effect in simulation.effects] == ["joint_compliance", "joint_coupling", "camera_moved"]
    assert isinstance(simulation.residual, Unexplained)


def test_the_page_s_python_runs(tmp_path, monkeypatch) -> None:
    robot, motion = arm(tmp_path), walk()
    recording = Recording(robot.joints, motion.q, Simulation(robot).positions(motion), t=motion.t)
    recording.write_csv(tmp_path / "measured.csv")
    monkeypatch.chdir(tmp_path)
    names: dict = {}
    exec(block("python"), names)
    np.testing.assert_array_equal(names["again"].positions(names["motion"]), names["x"])
