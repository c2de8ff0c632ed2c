"""The Jacobians of the fit are the derivatives of the simulated measurement."""

from __future__ import annotations

import numpy as np
import pytest
from effect_arms import arm, everywhere, sized, walk

from bodyschema.effects import EFFECT_TYPES, Simulation

# Of the largest derivative. That a spring's deflection changes its own load is left out.
EXACT, AT_A_KNOT, TO_FIRST_ORDER = 1e-5, 1e-3, 0.02
MOTION = walk()
OTHERS = (
    ("joint_scale", "elbow", None),
    ("joint_coupling", "elbow", "neck_yaw"),
    ("backlash", "wrist", None),
    ("link_geometry", "neck_tilt", None),
    ("link_geometry", "elbow", None),
    ("tool_slip", None, None),
    ("camera_pose", None, None),
    ("camera_moved", None, None),
    ("camera_scale", None, None),
    ("camera_focal", None, None),
    ("lens_distortion", None, None),
    ("thermal_drift", None, None),
)


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    return arm(tmp_path_factory.mktemp("arm"))


def numerical(simulation, place, number, step):
    """Return the numerical derivative (n, 3) with respect to one number of the effect at `place`."""
    outcomes = []
    for change in (step, -step):
        effects = list(simulation.effects)
        values = np.array(effects[place].values)
        values[number] += change
        effects[place] = effects[place].with_values(values)
        outcomes.append(simulation.with_effects(effects).positions(MOTION))
    return (outcomes[0] - outcomes[1]) / (2.0 * step)


def sprung(robot, kind):
    """Return the joint compliance without which a payload has no effect."""
    return (sized(robot, ("joint_compliance", "elbow", None), 1.0),) if kind == "payload" else ()


def check_columns(robot, others, effect):
    others = (*others, *sprung(robot, effect.name))
    simulation = Simulation(robot, (*others, effect))
    columns = simulation.run(MOTION).columns(effect)
    assert columns.shape == (len(MOTION), 3, len(effect.parameters))
    for k, parameter in enumerate(effect.parameters):
        if not parameter.is_amount:
            assert not columns[:, :, k].any()
            continue
        expected = numerical(simulation, len(others), k, 1e-5 * parameter.usual)
        allowed = TO_FIRST_ORDER if effect.name in ("joint_compliance", "payload") else EXACT
        if effect.name == "camera_latency":  # between two readings the path bends otherwise than between the next two
            allowed = AT_A_KNOT
        assert np.abs(columns[:, :, k] - expected).max() <= allowed * max(np.abs(expected).max(), 1e-9)


def somewhere(robot, kind, seed):
    """Return one of the places where the effect can sit."""
    places = [place for place in everywhere(robot) if place[0] == kind]
    return places[np.random.default_rng(seed).integers(len(places))]


@pytest.mark.parametrize("kind", list(EFFECT_TYPES))
def test_jacobian_columns_match_derivatives_of_single_effect(robot, kind) -> None:
    for share, seed in ((0.0, 1), (0.5, 2), (1.0, 3)):
        check_columns(robot, (), sized(robot, somewhere(robot, kind, seed), share, seed))


@pytest.mark.parametrize("kind", list(EFFECT_TYPES))
def test_jacobian_columns_match_derivatives_with_other_effects_present(robot, kind) -> None:
    others = tuple(sized(robot, place, 1.0, 4) for place in OTHERS)
    check_columns(robot, others, sized(robot, somewhere(robot, kind, 4), 1.0, 4))


@pytest.mark.parametrize("kind", list(EFFECT_TYPES))
def test_with_nominal_amounts_nothing_changes(robot, kind) -> None:
    nominal = Simulation(robot).positions(MOTION)
    for place in everywhere(robot):
        if place[0] == kind:
            same = Simulation(robot, (sized(robot, place, 0.0),)).positions(MOTION)
            np.testing.assert_allclose(same, nominal, rtol=0, atol=1e-12)


@pytest.mark.parametrize("kind", list(EFFECT_TYPES))
def test_half_the_usual_size_moves_positions(robot, kind) -> None:
    for place in everywhere(robot):
        if place[0] == kind and place != ("joint_compliance", "neck_yaw", None):  # whose axis is vertical
            beside = sprung(robot, kind)
            nominal = Simulation(robot, beside).positions(MOTION)
            moved = Simulation(robot, (*beside, sized(robot, place, 0.5))).positions(MOTION) - nominal
            assert np.linalg.norm(moved, axis=1).max() > 1e-6, place


def test_hand_guided_torque_free_arm_shows_no_compliance(tmp_path) -> None:
    robot = arm(tmp_path, hold="torque_free")
    spring = sized(robot, ("joint_compliance", "elbow", None), 1.0)
    run = Simulation(robot, (spring,)).run(MOTION)
    np.testing.assert_array_equal(run.measured, Simulation(robot).positions(MOTION))
    assert not run.columns(spring).any()


def test_effect_and_residual_do_not_influence_each_other(robot) -> None:
    class Bump:
        def predict(self, q):
            return 0.01 * np.sin(q[:, :3])

    effect = sized(robot, ("joint_scale", "elbow", None), 1.0)
    alone, both = Simulation(robot, (effect,)), Simulation(robot, (effect,), Bump())
    np.testing.assert_allclose(
        both.positions(MOTION), alone.positions(MOTION) + 0.01 * np.sin(MOTION.q[:, :3]), atol=1e-15
    )
    np.testing.assert_array_equal(both.run(MOTION).columns(effect), alone.run(MOTION).columns(effect))


def test_residual_is_evaluated_once_per_motion_across_effects(robot) -> None:
    asked = []

    class Bump:
        def predict(self, q):
            asked.append(len(q))
            return 0.01 * np.sin(q[:, :3])

    before = Simulation(robot, (), Bump())
    before.positions(MOTION)
    before.with_effects([sized(robot, ("joint_scale", "elbow", None), 1.0)]).positions(MOTION)
    assert asked == [len(MOTION)]
