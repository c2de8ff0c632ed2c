"""`bodyschema calibrate latency`: data collection and command line."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from scripted_sources import Walk
from small_arm import write_small_arm

from bodyschema.calibration.latency import Latency, LatencyError
from bodyschema.cli.hardware.wiggling import collected
from bodyschema.cli.main import app
from bodyschema.daemon.sampler.sources import Sources
from bodyschema.interfaces.errors import BodyschemaError, ConfigError, SourceLost
from bodyschema.interfaces.records import MarkerFix, MarkerMiss
from bodyschema.robot.description import RobotDescription


def seen(folder: Path, every: int) -> Sources:
    """Return a walk in which every `every`-th image shows the marker; in the others it is at the border."""
    walk = Walk(RobotDescription.load(write_small_arm(folder)), 40)
    steps = [
        fix if k % every == 0 or not isinstance(fix, MarkerFix) else MarkerMiss(fix.t, "at_border")
        for k, fix in enumerate(walk.fixes, 1)
    ]
    return walk.sources(fixes=steps)


def test_often_missed_marker_is_reported_with_reason(tmp_path) -> None:
    found = collected(seen(tmp_path, 2), 5.0, lambda _: None)
    assert found.summary == "the marker was found in 20 of 40 images: 20 at border"


def test_found_marker_causes_no_complaint(tmp_path) -> None:
    assert collected(seen(tmp_path, 1), 5.0, lambda _: None).summary == ""


def test_never_found_marker_error_names_the_reasons(tmp_path) -> None:
    with pytest.raises(LatencyError, match="found in none of 40 images: 40 at border"):
        collected(seen(tmp_path, 1000), 5.0, lambda _: None)


def test_lost_encoders_error_names_cause_and_remedy(tmp_path) -> None:
    walk = Walk(RobotDescription.load(write_small_arm(tmp_path)), 40)
    lost = walk.sources(readings=[*walk.readings[:20], SourceLost("joint 'waist' (ID 1): a garbled answer")])
    with pytest.raises(LatencyError, match=r"lost while the arm was moved \(joint 'waist' .* answer\). Try again"):
        collected(lost, 5.0, lambda _: None)


def test_recording_and_simulation_exclude_each_other(tmp_path) -> None:
    words = ["calibrate", "latency", str(tmp_path / "w.csv"), "--sim", "--robot", str(write_small_arm(tmp_path))]
    with pytest.raises(BodyschemaError, match="not both"):
        app(words, exit_on_error=False, result_action="return_value")


@pytest.mark.soak
def test_the_simulated_robot_has_no_latency(tmp_path, monkeypatch, capsys) -> None:
    pytest.importorskip("pybullet")
    monkeypatch.chdir(tmp_path)
    app(["init", "--sim"], exit_on_error=False, result_action="return_value")
    with Path("robot.toml").open("a", encoding="utf-8") as file:
        # Cheaper images, and fewer.
        file.write("[sim.camera]\nclutter = 0\nscene_step = 4\nsupersampling = 1\nrate_hz = 20\n")
    capsys.readouterr()
    words = ["calibrate", "latency", "--sim", "--json", "--seconds", "3"]
    app(words, exit_on_error=False, result_action="return_value")
    found = json.loads(capsys.readouterr().out)
    assert np.abs(found["latency_s"]) < 3 * found["sigma_s"] + 1e-3
    assert found["sigma_s"] < 3e-3


def measured_by(folder: Path, tables: str, *words: str) -> Path:
    """Run the command on a recording of a small arm, whose robot.toml has `tables` besides."""
    file = write_small_arm(folder, tables)
    (folder / "w.csv").write_text("not read")
    command = ["calibrate", "latency", str(folder / "w.csv"), "--robot", str(file), *words]
    app(command, exit_on_error=False, result_action="return_value")
    return file


@pytest.fixture
def known(monkeypatch) -> None:
    """Let any recording show the same latency."""
    found = Latency(latency_s=0.03412, sigma_s=0.00121, residual_m=1e-3, speed_m_s=0.3, fixes=150)
    monkeypatch.setattr("bodyschema.cli.hardware.wiggling.read_wiggle", lambda *_: None)
    monkeypatch.setattr("bodyschema.calibration.latency.latency_of", lambda *_: found)


BOTH = "latency_s = 0.0341\nlatency_sigma_s = 0.0012\n"


@pytest.mark.usefixtures("known")
def test_missing_camera_table_prints_values_for_manual_entry(tmp_path, capsys) -> None:
    file = measured_by(tmp_path, "")
    out = capsys.readouterr().out
    assert BOTH in out
    assert "there is no table [vision.cameras]" in out
    before = file.read_bytes()
    with pytest.raises(ConfigError, match=r"yourself: latency_s = 0\.0341, latency_sigma_s = 0\.0012"):
        measured_by(tmp_path, "", "--write")
    assert BOTH in capsys.readouterr().out
    assert file.read_bytes() == before


@pytest.mark.usefixtures("known")
def test_written_values_are_those_that_were_printed(tmp_path, capsys) -> None:
    cameras = 'two = {left = "a", right = "b", image_size_px = [640, 480]}'
    file = measured_by(tmp_path, f"[vision.cameras]\n{cameras}\n", "--write")
    out = capsys.readouterr().out
    assert BOTH in out
    assert f"Written; the old file is {file}.before" in out
    assert file.read_text(encoding="utf-8").endswith(f"{cameras}\n{BOTH}")
