"""Causes are named where tolerances had grown to follow them."""

from __future__ import annotations

from pathlib import Path

import pytest

from bodyschema.diagnosis.diagnosis import diagnose
from bodyschema.effects import load_simulation
from bodyschema.recordings.recording import Recording

from .dense_hide import hide_dense


def named(seed: int, rows: int | None, folder: Path) -> set[tuple[str, str | None]]:
    """Return the causes that the diagnosis names of five hidden ones."""
    hide_dense(seed, folder, rows=rows, count=5)
    robot_file = next(folder.rglob("robot.toml"))
    simulation = load_simulation(robot_file)
    found = diagnose(Recording.read(robot_file.parent / "measured.csv", simulation.robot.joints), simulation)
    return {(cause.name, cause.where) for cause in found.causes}


@pytest.mark.soak
def test_link_turned_obliquely_is_named_beside_four_causes(tmp_path: Path) -> None:
    # The link is turned by 1.6° about an oblique axis.
    assert named(53001, 600, tmp_path) == {
        ("tool_slip", None),
        ("camera_moved", None),
        ("backlash", "j3"),
        ("joint_compliance", "j3"),
        ("link_geometry", "j4"),
    }


@pytest.mark.soak
def test_offset_resembling_tolerances_is_named_beside_four_causes(tmp_path: Path) -> None:
    # The offset is 1.4°, and the noise 0.02 mm.
    assert named(54102, None, tmp_path) == {
        ("tool_slip", None),
        ("joint_scale", "j4"),
        ("backlash", "j1"),
        ("backlash", "j4"),
        ("joint_offset", "j4"),
    }
