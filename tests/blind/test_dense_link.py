"""A bent link is named where tolerances had grown to follow it."""

from __future__ import annotations

from pathlib import Path

import pytest

from bodyschema.diagnosis.diagnosis import diagnose
from bodyschema.effects import load_simulation
from bodyschema.recordings.recording import Recording

from .dense_hide import hide_dense

# A slipped tool, a bumped camera, backlash, a spring, and a link that is turned by 1.6° about an oblique axis.
SEED = 53001


@pytest.mark.soak
def test_a_link_of_which_each_turn_alone_is_worth_nothing_is_named_beside_four_causes(tmp_path: Path) -> None:
    hide_dense(SEED, tmp_path, rows=600, count=5)
    robot_file = next(tmp_path.rglob("robot.toml"))
    simulation = load_simulation(robot_file)
    found = diagnose(Recording.read(robot_file.parent / "measured.csv", simulation.robot.joints), simulation)
    named = {(cause.name, cause.where) for cause in found.causes}
    assert named == {
        ("tool_slip", None),
        ("camera_moved", None),
        ("backlash", "j3"),
        ("joint_compliance", "j3"),
        ("link_geometry", "j4"),
    }
