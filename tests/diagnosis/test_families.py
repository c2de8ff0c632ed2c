"""Unnamed error families: their columns and numbers agree with the motions they describe."""

from __future__ import annotations

import numpy as np
import pytest
from planted_cases import desk_arm, measured, start_of, walk

from bodyschema.diagnosis.fit.alignment import aligned
from bodyschema.diagnosis.fit.fit import Fit
from bodyschema.diagnosis.fit.observations import Observations
from bodyschema.diagnosis.unnamed.families import DiscrepancyFamily, families
from bodyschema.diagnosis.unnamed.family_fits import PreparedFamily, UnnamedFamilies
from bodyschema.effects import Simulation
from bodyschema.robot.description import RobotDescription
from bodyschema.sim_backend import model_file


@pytest.fixture(scope="module")
def start() -> Fit:
    robot = desk_arm()
    return start_of(robot, walk(robot, 1), (), 1)


@pytest.fixture(scope="module")
def found(start) -> list[DiscrepancyFamily]:
    return families(start.run)


def test_family_columns_match_moves_times_amounts(start, found) -> None:
    rng = np.random.default_rng(0)
    for family in found:
        columns = family.columns(start.run)
        numbers = rng.normal(size=columns.shape[2])
        by = family.moved_by(start.run, numbers)
        np.testing.assert_allclose(columns @ numbers, np.einsum("nia,na->ni", family.moves(start.run), by), atol=1e-9)


def test_subfamily_moves_as_the_whole_family_does(start, found) -> None:
    rng = np.random.default_rng(0)
    bodies = [family for family in found if family.kind == "body" and family.ties is None]
    assert bodies
    for family in bodies:
        way = PreparedFamily.of(family, start)
        part = way.along(np.linalg.qr(rng.normal(size=(way.amounts, 2)))[0])
        numbers = rng.normal(size=len(part.scales)) / part.scales
        whitened = start.observations.whitened((part.family.columns(start.run) @ numbers)[:, :, None]).ravel()
        np.testing.assert_allclose(part.columns @ (part.scales * numbers), whitened, rtol=1e-6, atol=1e-6)


def test_link_compliant_at_near_end_rotates_about_carrier() -> None:
    robot = RobotDescription.load(model_file("upper_body"))
    run = start_of(robot, walk(robot, 1, rows=50), (), 1).run
    found, gravity = families(run), run.simulation.gravity
    joints = np.flatnonzero(~np.array(run.simulation.upward))
    assert len(joints)
    for k in joints:
        what = f"what carries {run.simulation.robot.joints[k]} gives under the arm's weight"
        *_, family = (one for one in found if one.what == what and one.ties is not None and not one.is_specific)
        T_camera_carrier = run.frames[:, k] @ np.linalg.inv(gravity.in_support_frames(k)[-1])
        axes, lever = T_camera_carrier[:, :3, :3], run.measured - T_camera_carrier[:, :3, 3]
        turned = np.cross(np.swapaxes(axes, 1, 2), lever[:, None, :]).swapaxes(1, 2)
        np.testing.assert_allclose(family.moves(run)[:, :, 3:], turned, atol=1e-9)
        np.testing.assert_allclose(family.moves(run)[:, :, :3], axes, atol=1e-9)


def test_wandering_focal_length_is_the_nearest_family() -> None:
    robot = desk_arm()
    motion, rng = walk(robot, 1, rows=150), np.random.default_rng(1)
    x = Simulation(robot).positions(motion) + 3e-4 * rng.normal(size=(len(motion), 3))
    wander = np.convolve(rng.normal(size=len(motion) + 40), np.full(41, 41**-0.5), mode="valid")
    x[:, 2] /= 1.0 + 0.01 * wander
    start = aligned(Observations.of(measured(robot, motion, x), Simulation(robot)), Simulation(robot))
    way, _ = UnnamedFamilies(start).nearest(start)[0]
    assert way.family.what == "the lens refocuses: its focal length wanders"


def test_hand_supported_arm_has_no_compliance_families() -> None:
    held = {"torque_free": "held"}
    for robot, gives in ((desk_arm(), False), (desk_arm(held), True)):
        found = families(Simulation(robot).run(walk(robot, 1)))
        assert any("under the arm's weight" in family.what for family in found) == gives
