"""A robot.toml with effects gives the learner the extended simulation to begin with."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping

import numpy as np
import pytest
from walked import DESK_ARM

from bodyschema.daemon.config import Config
from bodyschema.effects import Effect, Motion, Simulation, write_extended
from bodyschema.interfaces.records import FloatArray
from bodyschema.learning.config import LearnerConfig
from bodyschema.learning.nominal import NominalModel, chain_tolerances
from bodyschema.learning.online_learner import OnlineLearner
from bodyschema.learning.solvers.solver import DirectSolver
from bodyschema.robot.description import RobotDescription

LINK, TURN = [0.005, 0.003, -0.004, 0.02, 0.01, -0.02], [0.03, 0.02]
RIGID: Mapping[str, list[float]] = {"link_geometry": LINK, "joint_offset": [0.03]}


@pytest.fixture(scope="module")
def robot() -> RobotDescription:
    text = DESK_ARM.read_text().replace("_known = false", "_known = true")
    return RobotDescription.from_tables(tomllib.loads(text), text, DESK_ARM)


def at(robot: RobotDescription, name: str, joint: int | None, values: list[float]) -> Effect:
    return Effect.at(robot, name, None if joint is None else robot.joints[joint], values=values)


def poses(robot: RobotDescription) -> FloatArray:
    shares = np.random.default_rng(3).uniform(0.05, 0.95, size=(300, len(robot.joints)))
    return robot.lower + shares * (robot.upper - robot.lower)


def error_m(nominal: NominalModel, simulation: Simulation) -> float:
    """Return the mean error of the learner's answers before any pair."""
    q = poses(simulation.robot)
    said = OnlineLearner(nominal, LearnerConfig(), DirectSolver()).snapshot.predict(q).x
    return float(np.linalg.norm(said - simulation.positions(Motion.still(q)), axis=1).mean())


def test_extended_prior_includes_rigid_effects(robot) -> None:
    simulation = Simulation(robot, tuple(at(robot, name, 2, values) for name, values in RIGID.items()))
    assert error_m(NominalModel.of(robot), simulation) > 5e-3
    assert error_m(NominalModel.extended_by(simulation), simulation) < 1e-9


@pytest.mark.parametrize(
    ("name", "joint", "values", "share"),
    [("camera_scale", None, [0.02], 1e-6), ("joint_eccentricity", 1, TURN, 0.7), ("joint_scale", 2, [0.03], 0.7)],
)
def test_extended_prior_approximates_non_rigid_effects(robot, name, joint, values, share) -> None:
    simulation = Simulation(robot, (at(robot, name, joint, values),))
    assert error_m(NominalModel.extended_by(simulation), simulation) < share * error_m(
        NominalModel.of(robot), simulation
    )


def test_extended_prior_applies_jumps_and_omits_backlash(robot) -> None:
    jump = Simulation(robot, (at(robot, "encoder_jump", 1, [0.05, 100.0]), at(robot, "backlash", 2, [0.1])))
    offset = Simulation(robot, (at(robot, "joint_offset", 1, [0.05]),))
    assert error_m(NominalModel.extended_by(jump), offset) < 1e-9


def test_unknown_frame_keeps_the_extended_arm_geometry(tmp_path) -> None:
    robot = RobotDescription.load(DESK_ARM)
    simulation = Simulation(robot, (at(robot, "link_geometry", 2, LINK), at(robot, "joint_eccentricity", 1, TURN)))
    file = write_extended(simulation, tmp_path / "out", "x")
    nominal = NominalModel.extended_by(Config.load(file).simulation)
    assert not nominal.frame_known
    np.testing.assert_allclose(nominal.chain.fixed, simulation.rigid_chain.fixed, atol=1e-12)


def test_another_extended_file_is_another_nominal_model(robot) -> None:
    tolerances = chain_tolerances(LearnerConfig())
    fingerprints = {
        nominal.fingerprint(tolerances)
        for nominal in (
            NominalModel.of(robot),
            NominalModel.extended_by(Simulation(robot)),
            NominalModel.extended_by(Simulation(robot, (at(robot, "joint_eccentricity", 1, TURN),))),
        )
    }
    assert len(fingerprints) == 2
