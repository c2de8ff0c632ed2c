"""extended.toml holds only what makes another recording more exact."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from planted_cases import ELBOW, SHOULDER, SIGMA_M, desk_arm, measured, motion_of, walk

from bodyschema.diagnosis.assess.residual_structure import ResidualStructure
from bodyschema.diagnosis.assess.stored import _Generalisation, stored
from bodyschema.diagnosis.diagnosis import _stored
from bodyschema.diagnosis.fit.alignment import aligned
from bodyschema.diagnosis.fit.background import BackgroundSettings, Scales
from bodyschema.diagnosis.fit.fit import Fit
from bodyschema.diagnosis.fit.observations import Observations
from bodyschema.diagnosis.search.held_out import Blocks, is_marker
from bodyschema.effects import Effect, Motion, Simulation
from bodyschema.interfaces.records import FloatArray
from bodyschema.robot.description import RobotDescription

ROWS = 100


@pytest.fixture(scope="module")
def robot() -> RobotDescription:
    return desk_arm()


def placed(robot: RobotDescription, off: FloatArray) -> Fit:
    """Return the fit of the camera and the marker to a walk in which the elbow is off by (n,) [rad]."""
    motion = walk(robot, 1, rows=ROWS)
    q = motion.q.copy()
    q[:, robot.joints.index(ELBOW)] += off
    x = Simulation(robot).positions(motion_of(q))
    x += SIGMA_M * np.random.default_rng([1, 1]).normal(size=x.shape)
    return aligned(Observations.of(measured(robot, motion, x), Simulation(robot)), Simulation(robot))


def test_a_joint_offset_is_stored(robot) -> None:
    start = placed(robot, np.full(ROWS, 0.04))
    found = start.with_causes([Effect.at(robot, "joint_offset", ELBOW, values=[0.0])])
    assert stored([start, found], is_marker(found)) is found


def test_tolerances_fitted_to_drift_are_not_stored(robot) -> None:
    start = placed(robot, 0.05 * np.sin(np.linspace(0.0, 30.0, ROWS)))
    large = start.with_tolerances(Scales(*[BackgroundSettings.largest_scale] * 3))
    assert np.square(large.residuals).sum() < np.square(start.residuals).sum()
    assert stored([start, large], is_marker(large)) is start


def test_written_model_is_aligned_to_all_rows(robot) -> None:
    start = placed(robot, np.zeros(ROWS))
    ignoring = start.to(start.observations.ignoring(np.arange(ROWS) < ROWS // 2))
    for fit in (ignoring, ignoring.with_tolerances(Scales())):
        # The camera may stand anywhere, so nothing is left of the mean of the rows by which it is placed.
        left = start.observations.x - fit.written.positions(start.observations.motion)
        np.testing.assert_allclose(left.mean(axis=0), 0.0, atol=1e-3 * SIGMA_M)


def test_written_model_is_aligned_between_marker_sides(robot) -> None:
    start = placed(robot, np.zeros(ROWS))
    ways = start.run.columns(Effect.at(robot, "tool_offset")) @ np.array([0.6, 0.0, 0.8])
    beyond = np.where(np.arange(ROWS) // 10 % 3, 2e-3, -2e-3)[:, None] * ways
    loose = replace(start.observations, x=start.observations.x + beyond)
    fit = start.to(loose.with_loose_marker(100.0, ways)).with_tolerances(Scales())
    left = loose.x - fit.written.positions(loose.motion)
    np.testing.assert_allclose(left.mean(axis=0), 0.0, atol=0.02 * SIGMA_M)


@pytest.mark.parametrize("seed", [1, 2, 5])
def test_tolerances_beside_gravity_loaded_marker_play_are_stored(robot, seed) -> None:
    rng, motion = np.random.default_rng(seed), walk(robot, seed)
    links = tuple(
        Effect.at(robot, "link_geometry", joint, values=rng.normal(size=6) * np.repeat([5e-4, 2e-3], 3))
        for joint in robot.joints
    )

    def seen(motion: Motion) -> tuple[FloatArray, FloatArray]:
        """Return the positions of a marker with play, and the direction of its play."""
        run = Simulation(robot, links).run(motion)
        ways = run.columns(Effect.at(robot, "tool_offset")) @ np.array([0.6, 0.0, 0.8])
        down = (ways @ run.simulation.camera_pose[:3, :3].T)[:, [2]]
        return run.measured + 2e-3 * np.sign(down) * ways, ways

    x, ways = seen(motion)
    recording = measured(robot, motion, x + SIGMA_M * rng.normal(size=x.shape))
    observations, elsewhere = Observations.of(recording, Simulation(robot)), walk(robot, 100 + seed)
    start = aligned(observations.without_history, Simulation(robot))
    loose = aligned(observations.with_loose_marker(100.0, ways), Simulation(robot)).with_tolerances(
        Scales(3.0, 3.0, 1.0)
    )
    assert stored([start, loose], is_marker(start)) is loose
    before, after = (np.square(fit.written.positions(elsewhere) - seen(elsewhere)[0]).sum() for fit in (start, loose))
    assert after < before


def test_fallback_model_is_refitted_to_all_rows(robot) -> None:
    start = placed(robot, np.zeros(ROWS))
    ignoring = start.to(start.observations.ignoring(np.arange(ROWS) < ROWS // 2))
    best = _stored(ignoring, ignoring, ignoring, ResidualStructure((), (), False, 1.0), Blocks.cut(ROWS))
    motion = start.observations.motion
    half, without_history = (
        np.abs(fit.simulation.positions(motion) - start.simulation.positions(motion)).max() for fit in (ignoring, best)
    )
    assert without_history < 0.05 * half


def test_a_cause_that_explains_nothing_is_not_stored(robot) -> None:
    start = placed(robot, np.zeros(ROWS))
    none = start.with_causes([Effect.at(robot, "joint_scale", SHOULDER, values=[0.0])])
    assert stored([start, none], is_marker(none)) is start


@pytest.mark.parametrize(
    ("gains", "variance"),
    [([9.0, -7.0, 8.0, -6.0, 7.0, -8.0, 9.0, -7.0, 8.0, -6.0], 0.0), ([0.0] * 10, -1.0), ([1.0] * 10, 11.0)],
    ids=["by chance", "of no fix that counts", "by less than it varies"],
)
def test_a_gain_that_is_not_sure_stores_nothing(robot, gains, variance) -> None:
    start = placed(robot, np.zeros(ROWS))
    simpler = _Generalisation(start, np.full(10, 20.0), 2.0)
    assert not _Generalisation(start, simpler.squares - gains, 2.0 + variance).is_better_than(simpler)
