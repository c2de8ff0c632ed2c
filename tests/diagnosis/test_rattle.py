"""A loose marker is no noise and no cause."""

from __future__ import annotations

import numpy as np
import pytest
from planted_cases import SIGMA_M, measured, scattered, surveyed_arm

from bodyschema.diagnosis.diagnosis import diagnose
from bodyschema.diagnosis.report.conclusion import conclusion
from bodyschema.diagnosis.report.result import DiagnosisFile
from bodyschema.effects import Effect, Simulation

HALF_M = 2e-3


@pytest.fixture(scope="module")
def file() -> DiagnosisFile:
    robot, rng = surveyed_arm(), np.random.default_rng(4)
    motion = scattered(robot, 1, rows=150)
    run = Simulation(robot).run(motion)
    sides = HALF_M * rng.choice([-1.0, 1.0], size=len(motion))
    way = np.array([0.6, 0.0, 0.8])
    x = run.measured + sides[:, None] * (run.columns(Effect.at(robot, "tool_offset")) @ way)
    noisy = x + SIGMA_M * rng.normal(size=x.shape)
    return conclusion(diagnose(measured(robot, motion, noisy), Simulation(robot)))


def test_a_loose_marker_is_unexplained_and_told_with_its_play(file) -> None:
    assert (file.verdict, file.causes) == ("unexplained", ())
    assert file.unexplained.rms_mm == pytest.approx(1e3 * HALF_M, rel=0.05)
    assert "Fasten the marker" in file.advice[0]


def test_the_play_of_a_loose_marker_is_not_in_the_noise(file) -> None:
    assert file.rms_mm.noise_floor == pytest.approx(1e3 * np.sqrt(3.0) * SIGMA_M, rel=0.15)
