"""Limits of a diagnosis are reported with their reasons."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from planted_cases import SHOULDER, Motion, desk_arm, seen, walk

from bodyschema.diagnosis.assess.explanation import Explanation, useful
from bodyschema.diagnosis.diagnosis import Diagnosis, diagnose
from bodyschema.diagnosis.report.conclusion import conclusion
from bodyschema.diagnosis.search.search import Search, are_only_descriptive
from bodyschema.effects import Effect, Simulation


@pytest.fixture(scope="module")
def small() -> Diagnosis:
    robot = desk_arm()
    truth = Effect.at(robot, "joint_offset", SHOULDER, values=[0.02])
    return diagnose(seen(robot, walk(robot, 1), (truth,), 1), Simulation(robot), only=("joint_offset", "joint_scale"))


def test_limitations_report_a_truncated_search(small) -> None:
    assert conclusion(small).limitations == small.hypotheses.limitations
    ended = dataclasses.replace(small, ended_early=True)
    assert "describe the error and do not explain it" in conclusion(ended).limitations[-1]


def test_limitations_report_content_missing_from_extended_toml(small) -> None:
    told = conclusion(dataclasses.replace(small, stored=small.aligned)).limitations
    assert any(line.startswith("extended.toml holds none of it") for line in told)


def test_truncated_search_is_unexplained(small) -> None:
    assert conclusion(small).verdict == "explained"
    ended = conclusion(dataclasses.replace(small, ended_early=True))
    assert ended.verdict == "unexplained"
    assert all(cause.probability <= 0.5 for cause in ended.causes)


def test_many_jumps_are_a_description_not_an_explanation(small) -> None:
    robot = small.extended.simulation.robot
    jumps = [Effect.at(robot, "encoder_jump", SHOULDER).with_ordinal(k) for k in range(4)]
    assert are_only_descriptive(jumps)
    assert not are_only_descriptive([*jumps[:3], *small.causes])


def test_rejected_effect_with_small_p_value_has_reason(small) -> None:
    rest = dataclasses.replace(small, extended=small.aligned, assessments=())
    rows = {(row.effect, row.where): row for row in conclusion(rest).rejected}
    assert rows["joint_offset", SHOULDER].p_value < 1e-3
    assert rows["joint_offset", SHOULDER].why
    assert all(not row.why for row in rows.values() if row.p_value >= 1e-3)


def test_rarely_crossed_backlash_is_reported_with_remedy() -> None:
    robot = desk_arm()
    way = walk(robot, 1)
    short = Motion(way.q, way.t, np.arange(len(way.q)) // 2)
    truth = Effect.at(robot, "backlash", SHOULDER, values=[0.12])
    found = diagnose(seen(robot, short, (truth,), 1), Simulation(robot), only=("backlash",))
    (told,) = [line for line in conclusion(found).limitations if "side of its backlash" in line]
    assert SHOULDER in told
    assert "Record longer runs" in told


def test_cause_without_held_out_gain_is_dropped(small) -> None:
    fit, robot = small.extended, small.extended.simulation.robot
    impossible = Effect.at(robot, "backlash", SHOULDER, values=[-0.001])
    begun = Explanation(fit.with_unfitted_causes([*fit.causes, impossible]), None, 0.0)
    search = Search(small.hypotheses.effects, lambda _: None)
    kept = useful(begun, search, small.blocks, lambda _: None).fit.causes
    assert [cause.key for cause in kept] == [cause.key for cause in fit.causes]
