"""Effects that share a direction beside the best geometry."""

from __future__ import annotations

from planted_cases import ELBOW, SHOULDER, desk_arm, start_of, walk

from bodyschema.diagnosis.alike import alike
from bodyschema.diagnosis.hypotheses import Hypotheses
from bodyschema.diagnosis.result import Alike, Errors
from bodyschema.diagnosis.text import beside_geometry
from bodyschema.effects import Effect

HELD = {'"torque_free"': '"held"'}


def _pairs(planted: Effect, seed: int = 3) -> list[tuple[str, str | None, str]]:
    robot = desk_arm(HELD)
    fit = start_of(robot, walk(robot, seed), (planted,), seed)
    hypotheses = Hypotheses.of(fit.simulation, fit.observations).effects
    return [(pair.one.name, pair.one.where, pair.other.name) for pair in alike(fit, hypotheses)]


def test_a_scale_and_an_eccentric_encoder_share_a_direction_over_part_of_a_turn():
    planted = Effect.at(desk_arm(HELD), "joint_eccentricity", ELBOW, None, (0.02, 0.02))
    assert ("joint_eccentricity", ELBOW, "joint_scale") in _pairs(planted)


def test_a_fine_ripple_shares_its_direction_with_nothing():
    planted = Effect.at(desk_arm(HELD), "joint_ripple", SHOULDER, None, (0.01, 0.01, 12.0))
    assert not [pair for pair in _pairs(planted) if pair[1] == SHOULDER]


def test_geometry_is_told_of_where_something_beside_it_can_be_told_in_more_than_one_way():
    errors = Errors(2.0, 0.7, 0.114, 0.08, 0.07)
    assert beside_geometry(errors, ()) == []
    pair = Alike("q2", "joint_eccentricity", "joint_compliance", 13.7, 11.3, 99.0, 84.0)
    geometry, shared = beside_geometry(errors, [pair])
    assert "0.7 mm to 0.114 mm" in geometry
    assert "joint_eccentricity and joint_compliance at q2 share a direction" in shared
