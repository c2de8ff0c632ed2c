from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from small_arm import write_small_arm

from daemon.config import Config
from daemon.wiring import check_sources, demonstration_model, open_sources, require_simulation
from interfaces.errors import ConfigError, RecordingError
from interfaces.records import MarkerFix


def load(folder: Path, tables: str = "") -> Config:
    return Config.load(write_small_arm(folder, tables), {})


def enter(config: Config, *, sim: bool) -> None:
    with open_sources(config, sim=sim):
        pass


def test_without_a_driver_the_two_ways_out_are_named(tmp_path) -> None:
    with pytest.raises(ConfigError, match=r"no driver is configured. Give --sim .*recording in the table \[drivers\]"):
        enter(load(tmp_path), sim=False)


def test_sources_can_be_checked_without_opening_any(tmp_path) -> None:
    with pytest.raises(ConfigError, match="no driver is configured"):
        check_sources(load(tmp_path), sim=False)


def test_a_recording_is_found_beside_robot_toml_and_read(tmp_path) -> None:
    (tmp_path / "walk.csv").write_text("waist,shoulder,x,y,z\n0.1,0.2,0.3,0.4,0.5\n")
    config = load(tmp_path, '[drivers]\nrecording = "walk.csv"\nspeed = 0\n')
    with open_sources(config, sim=False) as sources, sources.joints, sources.marker:
        fix = sources.marker.read(1.0)
    assert isinstance(fix, MarkerFix)
    assert np.array_equal(fix.x, [0.3, 0.4, 0.5])


def test_a_recording_with_a_mistake_names_line_and_column(tmp_path) -> None:
    (tmp_path / "walk.csv").write_text("waist,shoulder,x,y,z\n0.1,0.2,0.3,0.4,0.5\n0.1,nan,0.3,0.4,0.5\n")
    with pytest.raises(RecordingError, match=r"walk.csv, line 3, column shoulder"):
        enter(load(tmp_path, '[drivers]\nrecording = "walk.csv"\n'), sim=False)


def test_a_recording_that_is_not_there_is_named(tmp_path) -> None:
    with pytest.raises(RecordingError, match=r"walk.csv"):
        enter(load(tmp_path, '[drivers]\nrecording = "walk.csv"\n'), sim=False)


def test_the_simulation_asks_for_a_stereo_camera(tmp_path) -> None:
    with pytest.raises(ConfigError, match=r"describes no stereo pair.*Add focal_px"):
        enter(load(tmp_path), sim=True)


def test_without_pybullet_the_simulation_names_the_extra(monkeypatch) -> None:
    monkeypatch.setattr("daemon.wiring.find_spec", lambda _name: None)
    with pytest.raises(ConfigError, match=r"Type: pip install 'bodyschema\[sim\]'"):
        require_simulation()


def test_the_demonstration_model_is_a_robot_in_order() -> None:
    assert Config.load(demonstration_model(), {}).robot.calibration is not None
