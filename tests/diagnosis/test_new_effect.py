"""A new effect of the camera is two files: what it does, and how it is presented."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from planted_cases import SIGMA_M, measured, scattered, surveyed_arm

from bodyschema.diagnosis.diagnosis import Diagnosis, diagnose
from bodyschema.diagnosis.report import presenters
from bodyschema.diagnosis.report.conclusion import conclusion
from bodyschema.diagnosis.report.page import About, page
from bodyschema.diagnosis.report.presenters import registry as presenting
from bodyschema.diagnosis.report.text import remedies
from bodyschema.effects import EFFECT_TYPES, Effect, Simulation, catalogue, load_simulation, registry, write_extended
from bodyschema.robot.description import RobotDescription

NAME, SKEW = "camera_skew", 0.02
EFFECT = """
from bodyschema.effects.effect_type import CameraEffect
from bodyschema.effects.parameter import Parameter


class CameraSkew(CameraEffect):
    name = "camera_skew"
    alters_report = True

    def parameters(self, prismatic):
        return (Parameter("skew", 0.01),)

    def reported(self, x, motion, values, calibration):
        x = x.copy()
        x[:, 0] += values[0] * x[:, 1]
        return x
"""
PRESENTER = """
from bodyschema.diagnosis.report.presenters.presenter import Presenter


class CameraSkew(Presenter):
    effect = "camera_skew"

    def finding(self, found):
        return f"the axes of the image are {found.numbers['skew']:.3f} rad from a right angle"

    def remedy(self, workshop, found):
        return f"Calibrate the camera of {workshop.robot.name} with a skew"
"""


@pytest.fixture(scope="module")
def two_files(tmp_path_factory: pytest.TempPathFactory):
    """Put the two files beside the others, and nothing else."""
    with pytest.MonkeyPatch.context() as patch:
        for package, text in ((catalogue, EFFECT), (presenters, PRESENTER)):
            folder: Path = tmp_path_factory.mktemp("beside")
            (folder / f"{NAME}.py").write_text(text)
            patch.setattr(package, "__path__", [*package.__path__, str(folder)])
        [new] = [effect for effect in registry.built_in() if effect.name not in EFFECT_TYPES]
        patch.setitem(EFFECT_TYPES, NAME, new)
        patch.setitem(presenting.PRESENTERS, NAME, presenting.built_in()[NAME])
        yield
        for package in (catalogue, presenters):
            sys.modules.pop(f"{package.__name__}.{NAME}")


@pytest.fixture(scope="module")
def robot() -> RobotDescription:
    return surveyed_arm()


@pytest.fixture(scope="module")
def diagnosis(two_files, robot: RobotDescription) -> Diagnosis:
    motion = scattered(robot, 4, 80)
    x = Simulation(robot).positions(motion)
    x[:, 0] += SKEW * x[:, 1]
    recording = measured(robot, motion, x + SIGMA_M * np.random.default_rng(4).normal(size=x.shape))
    return diagnose(recording, Simulation(robot), only=(NAME, "camera_scale", "lens_distortion", "joint_offset"))


def test_a_new_effect_is_found_with_its_size(diagnosis) -> None:
    [cause] = conclusion(diagnosis).causes
    assert cause.effect == NAME
    assert cause.parameters["skew"].value == pytest.approx(SKEW, abs=0.002)


def test_new_effect_is_described_by_its_presenter(diagnosis, robot) -> None:
    file = conclusion(diagnosis)
    told = remedies(file, robot, np.zeros(len(robot.joints)), np.zeros(len(robot.joints)))
    assert "from a right angle" in file.sentence
    assert told == [f"Calibrate the camera of {robot.name} with a skew"]
    assert "from a right angle" in page(diagnosis, file, told, About("a.csv", "desk", "1.2.3"))


def test_an_alternative_without_a_noun_has_its_name(two_files) -> None:
    assert presenting.named(NAME, None, None) == "camera skew"


def test_a_new_effect_is_kept_in_extended_toml(diagnosis, tmp_path) -> None:
    simulation, motion = diagnosis.extended.simulation, diagnosis.extended.run.motion
    again = load_simulation(write_extended(simulation, tmp_path, "a test"))
    np.testing.assert_allclose(again.positions(motion), simulation.positions(motion), atol=1e-9)


def test_new_effect_derivatives_follow_from_its_report(two_files, robot) -> None:
    motion = scattered(robot, 1, 20)
    others = (
        Effect.at(robot, "camera_scale", values=[0.1]),
        Effect.at(robot, "joint_offset", robot.joints[1], values=[0.1]),
    )
    run = Simulation(robot, others).run(motion)
    skew = Effect.at(robot, NAME, values=[0.0])
    expected = np.zeros((20, 3, 1))
    expected[:, 0, 0] = run.measured[:, 1]
    np.testing.assert_allclose(run.columns(skew), expected, atol=1e-8)
    skewed = Simulation(robot, (*others, skew.with_values(np.array([0.3])))).run(motion)
    sheared = run.columns(others[1])
    sheared[:, 0] += 0.3 * sheared[:, 1]
    np.testing.assert_allclose(skewed.columns(others[1]), sheared, atol=1e-8)
