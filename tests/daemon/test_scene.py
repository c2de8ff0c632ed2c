from __future__ import annotations

from pathlib import Path

import pytest

from daemon.demo.scene import prepare
from interfaces.errors import ConfigError


def everything(folder: Path) -> dict[str, bytes]:
    return {str(path): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_a_folder_of_somebody_s_own_robot_is_refused_and_left_as_it_is(tmp_path) -> None:
    (tmp_path / "state").mkdir()
    for name in ("robot.toml", "recording.csv", "state/pairs.sqlite"):
        (tmp_path / name).write_text("mine")
    before = everything(tmp_path)
    with pytest.raises(ConfigError, match=r"no demo was here\. Give another --out"):
        prepare(tmp_path, seed=0)
    assert everything(tmp_path) == before


def test_what_an_earlier_demo_left_is_replaced(tmp_path) -> None:
    scene = prepare(tmp_path / "demo", seed=0)
    scene.recording_file.write_text("old")
    scene.store_file.parent.mkdir()
    scene.store_file.write_text("old")
    again = prepare(tmp_path / "demo", seed=1)
    assert not again.recording_file.exists()
    assert not again.store_file.exists()
    assert "seed = 1" in again.robot_file.read_text()
