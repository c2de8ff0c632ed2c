"""The simulated world agrees with the simulation at every joint: a head's, a prismatic one, one behind a held joint."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
from effect_arms import arm, everywhere, sized, walk

from bodyschema.effects import EFFECT_TYPES, Motion, Simulation
from bodyschema.sim_backend import ErrorConfig, SimConfig
from bodyschema.sim_backend.posed import PosedWorld, _Settings

CLOSE_M = 1e-6
COMPLIANT = ("joint_compliance", "shoulder_lift", None)  # without it no payload shows
VERTICAL = ("joint_compliance", "neck_yaw", None)  # no weight turns it
NO_ERRORS = ErrorConfig(
    joint_offset_rad=0, link_length_m=0, link_axis_rad=0, camera_position_m=0, camera_rotation_rad=0, tool_m=0
)


class NoRenderer:
    """Replacement of the renderer that paints nothing."""

    def __init__(self, *arguments) -> None: ...

    def __enter__(self):
        return self

    def __exit__(self, *error) -> None: ...


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    return arm(tmp_path_factory.mktemp("arm"))


def shown(simulation: Simulation, postures, monkeypatch):
    """Return the positions (n, 3) [m] that an ideal tracker would measure in the posed world."""
    monkeypatch.setattr("bodyschema.sim_backend.posed.RenderProcess", NoRenderer)
    with PosedWorld(simulation.robot, SimConfig(errors=NO_ERRORS), postures, simulation) as world:
        return np.array([world.scene(number).x_seen for number in range(len(postures))])


def rows(postures) -> Motion:
    return Motion(
        postures, _Settings.period_s * np.arange(1.0, len(postures) + 1), np.zeros(len(postures), dtype=np.int64)
    )


def test_a_simulation_that_has_run_can_be_pickled(robot) -> None:
    simulation, motion = Simulation(robot), rows(walk(2).q[:20])
    before = simulation.positions(motion)
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(simulation)).positions(motion), before)


@pytest.mark.parametrize("name", [name for name in EFFECT_TYPES if name != "camera_latency"])
def test_simulated_world_shows_each_effect_at_every_joint(robot, name, monkeypatch) -> None:
    postures = walk(2).q[:20]
    others = (sized(robot, COMPLIANT, 1.0),) if name == "payload" else ()
    without = Simulation(robot, others).positions(rows(postures))
    places = [place for place in everywhere(robot) if place[0] == name and place != VERTICAL]
    assert places
    for place in places:
        simulation = Simulation(robot, (*others, sized(robot, place, 1.0, 3)))
        expected = simulation.positions(rows(postures))
        assert np.abs(expected - without).max() > CLOSE_M, place
        assert np.abs(shown(simulation, postures, monkeypatch) - expected).max() < CLOSE_M, place


def test_all_effects_at_once_show_in_the_world(robot, monkeypatch) -> None:
    postures = walk(4).q[:20]
    places = [place for place in everywhere(robot) if place[0] != "camera_latency"]
    simulation = Simulation(robot, tuple(sized(robot, place, 0.3, k) for k, place in enumerate(places)), Wave())
    apart = shown(simulation, postures, monkeypatch) - simulation.positions(rows(postures))
    assert np.abs(apart).max() < CLOSE_M


class Wave:
    """A residual."""

    def predict(self, q):
        return 0.003 * np.cos(q[:, 2:5])


def test_true_chain_includes_geometric_effects_and_random_errors(robot, monkeypatch) -> None:
    monkeypatch.setattr("bodyschema.sim_backend.posed.RenderProcess", NoRenderer)
    postures = walk(5).q[:20]
    places = [place for place in everywhere(robot) if EFFECT_TYPES[place[0]].rigid]
    simulation = Simulation(robot, tuple(sized(robot, place, 1.0, k) for k, place in enumerate(places)))
    with PosedWorld(robot, SimConfig(seed=7), postures, simulation) as world:
        x = np.array([world.scene(number).x_seen for number in range(len(postures))])
        assert np.abs(x - world.true_chain().positions(postures)).max() < CLOSE_M
    assert np.abs(x - simulation.positions(rows(postures))).max() > 0.01
