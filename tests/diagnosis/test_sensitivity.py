"""An unnamed error depends on the joints that hold a twentieth of its variance or more."""

from __future__ import annotations

import numpy as np
import pytest
from planted_cases import BASE, ELBOW, SHOULDER, desk_arm, scattered

from bodyschema.diagnosis.unnamed.families import DiscrepancyFamily, joints_of
from bodyschema.effects import PipelineRun, Simulation
from bodyschema.interfaces.records import FloatArray

HOLDING = {0.02: {SHOULDER}, 0.1: {SHOULDER, ELBOW}}


@pytest.mark.parametrize("share", HOLDING)
def test_joint_holding_a_twentieth_of_variance_is_reported(share) -> None:
    robot = desk_arm()
    run = Simulation(robot).run(scattered(robot, 1, rows=2000))
    both = [robot.joints.index(joint) for joint in (SHOULDER, ELBOW)]
    spread = run.motion.q[:, both].std(axis=0)

    def amounts(run: PipelineRun) -> FloatArray:
        return run.motion.q[:, both] / spread

    family = DiscrepancyFamily("two joints", "place", None, (), False, lambda run: run.measured[:, :, None], amounts)
    found = joints_of(family, np.sqrt([1.0 - share, share]), run)
    assert {robot.joints[k] for k in found} == HOLDING[share]


def test_erring_joint_is_reported_whatever_its_variance_share() -> None:
    robot = desk_arm()
    run, base, elbow = Simulation(robot).run(scattered(robot, 1)), *(robot.joints.index(j) for j in (BASE, ELBOW))
    moves, amounts = lambda run: run.by_joint[:, :, [base]], lambda run: run.motion.q[:, [elbow]]
    found = joints_of(
        DiscrepancyFamily("an error of the base", "joint", base, (elbow,), False, moves, amounts), np.ones(1), run
    )
    assert found == {base, elbow}
