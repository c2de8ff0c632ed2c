"""Ripples at regular angles are aliased to other ripples, and the report says so."""

from __future__ import annotations

import numpy as np
import pytest
from planted_cases import motion_of, seen, surveyed_arm

from bodyschema.diagnosis.fit.alignment import aligned
from bodyschema.diagnosis.fit.observations import Observations
from bodyschema.diagnosis.search.drives import alias_sentences, aliases
from bodyschema.effects import Effect, Simulation

GRID_RAD = np.radians(5.0)  # 72 angles a turn


def fitted(q_of_joint):
    """Return a fit with a ripple of 50 cycles per turn in one joint, read at angles (n,)."""
    robot, rng = surveyed_arm(), np.random.default_rng(1)
    q = rng.uniform(-0.5, 0.5, (len(q_of_joint), len(robot.joints)))
    q[:, 1] = q_of_joint
    ripple = Effect.at(robot, "joint_ripple", robot.joints[1], values=[0.01, 0.0, 50.0])
    motion = motion_of(q)
    recording = seen(robot, motion, (ripple,), 0)
    simulation = Simulation(robot)
    return aligned(Observations.of(recording, simulation), simulation).with_causes([ripple])


def test_multiples_of_five_degrees_alias_by_72_cycles() -> None:
    fit = fitted(GRID_RAD * np.random.default_rng(0).integers(-9, 10, 150))
    found = aliases(fit, fit.causes[0])
    cycles = fit.causes[0].values[-1]
    assert found[:3] == pytest.approx(sorted([72.0 - cycles, 144.0 - cycles, 72.0 + cycles]), abs=1.0)
    assert "looks like one of 22, 94, 122" in alias_sentences(fit)[0]


def test_uneven_angles_have_no_alias() -> None:
    fit = fitted(np.random.default_rng(0).uniform(-0.8, 0.8, 150))
    assert alias_sentences(fit) == []
