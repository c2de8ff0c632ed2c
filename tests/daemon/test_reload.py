"""What takes effect when robot.toml is read again, and what waits for a restart."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

import pytest
from small_arm import write_small_arm

from bodyschema.daemon.config import Config, Tables
from bodyschema.daemon.learner import learner
from bodyschema.daemon.sampler import devices
from bodyschema.daemon.service.reload import Key, reload

TAG = '[daemon]\nmin_step_deg = 1\n[vision]\nmarker = "tag"\nradius_m = 0.02\n[vision.tag]\nside_sigma_m = 0.0001\n'
NEW_SOURCE = '[[marker_source]]\nkind = "udp"\n[daemon]'
LEARNER, SAMPLER = (learner.TABLES, learner.CHANGEABLE), (devices.TABLES, devices.CHANGEABLE)


@pytest.mark.parametrize(
    ("process", "old", "new", "changed", "needs_restart"),
    [
        (LEARNER, "side_sigma_m = 0.0001", "side_sigma_m = 0.001", [], ["vision.tag.side_sigma_m"]),
        (LEARNER, 'marker = "tag"', 'marker = "ball"', [], ["vision.marker"]),
        (LEARNER, "radius_m = 0.02", "radius_m = 0.03", [], []),
        (LEARNER, "[daemon]", NEW_SOURCE, [], ["marker_source"]),
        (SAMPLER, "[daemon]", NEW_SOURCE, [], ["marker_source"]),
        (SAMPLER, "min_step_deg = 1", "min_step_deg = 2", ["daemon.min_step_deg = 2.0"], []),
    ],
)
def test_a_changed_setting_is_followed_or_told(
    process: tuple[Collection[str], Collection[Key]],
    old: str,
    new: str,
    changed: list[str],
    needs_restart: list[str],
    tmp_path: Path,
) -> None:
    config = Config.load(write_small_arm(tmp_path, TAG), {})
    config.file.write_text(config.file.read_text().replace(old, new))
    found = reload(config, *process)
    assert (found.changed, found.needs_restart) == (changed, needs_restart)


def test_every_table_is_followed_by_a_process() -> None:
    assert {name.partition(".")[0] for name in (*learner.TABLES, *devices.TABLES)} == set(Tables.__struct_fields__)
