from __future__ import annotations

import tomllib
from pathlib import Path

import numpy as np
import pytest
from effect_arms import SLIDE, arm, everywhere, sized, walk
from hypothesis import given
from hypothesis import strategies as st

from bodyschema.effects import Effect, Simulation, Unexplained, load_simulation, write_extended
from bodyschema.effects.files import MODEL_FILE
from bodyschema.interfaces.errors import ConfigError, RobotError
from bodyschema.robot.description import RobotDescription
from kbmaps import JointBasis, KernelLearner, RigidChain, TensorTrain

HEADING = "Extended by a test"


@pytest.fixture(scope="module")
def robot(tmp_path_factory) -> RobotDescription:
    return arm(tmp_path_factory.mktemp("arm"))


def extended(tmp_path, entry: str):
    """Load a robot.toml with this text after its tables."""
    file = arm(tmp_path).file
    file.write_text(file.read_text() + entry)
    return load_simulation(file)


def refused(tmp_path, entry: str) -> RobotError:
    with pytest.raises(RobotError) as caught:
        extended(tmp_path, entry)
    return caught.value


def line_with(error: ConfigError, text: str) -> int:
    """Return the number of the line that contains `text` in the file that the error names."""
    lines = Path(str(error.file)).read_text().splitlines()
    return next(number for number, line in enumerate(lines, 1) if text in line)


BASES = tuple(JointBasis.orthonormal(-1.5, 1.5) for _ in range(2))
TURN = RigidChain(np.tile(np.eye(4), (3, 1, 1)), np.tile([0.0, 0.0, 1.0], (2, 1)), np.zeros(2, dtype=bool)).with_tool(
    [0.004, 0.001, 0.002]
)


def kernel() -> KernelLearner:
    learner = KernelLearner(BASES)
    q = np.random.default_rng(0).uniform(-1, 1, (60, 2))
    learner.learn(q, TURN.positions(q), 1e-4)
    return learner


@given(st.data(), st.floats(0.0, 1.0), st.integers(0, 100))
def test_effects_round_trip_through_file_bit_for_bit(robot, tmp_path_factory, data, share, seed) -> None:
    places = data.draw(st.lists(st.sampled_from(everywhere(robot)), max_size=6))
    written = Simulation(robot, tuple(sized(robot, place, share, seed) for place in places))
    read = load_simulation(write_extended(written, tmp_path_factory.mktemp("out"), HEADING))
    assert [effect.key for effect in read.effects] == [effect.key for effect in written.effects]
    for again, effect in zip(read.effects, written.effects, strict=True):
        np.testing.assert_array_equal(again.values, effect.values)
    np.testing.assert_array_equal(read.positions(walk()), written.positions(walk()))


def test_extended_file_loads_as_robot_toml_anywhere(robot, tmp_path) -> None:
    effect = Effect.at(robot, "joint_offset", "elbow", values={"offset_rad": 0.02})
    file = write_extended(Simulation(robot, (effect,)), tmp_path / "far" / "away", HEADING)
    described = RobotDescription.load(file)
    np.testing.assert_array_equal(described.chain.fixed, robot.chain.fixed)
    assert described.robot.held_at == robot.robot.held_at
    assert tomllib.loads(file.read_text())["daemon"] == {"state_dir": "state"}


def test_second_extension_keeps_effects_of_the_first(robot, tmp_path) -> None:
    first = Simulation(robot, (Effect.at(robot, "joint_offset", "elbow", values=[0.02]),))
    once = load_simulation(write_extended(first, tmp_path / "a", HEADING))
    second = once.with_effects((*once.effects, Effect.at(once.robot, "backlash", SLIDE, values=[0.001])))
    twice = load_simulation(write_extended(second, tmp_path / "b", HEADING))
    assert [effect.name for effect in twice.effects] == ["joint_offset", "backlash"]


def test_two_ripples_of_one_joint_round_trip(robot, tmp_path) -> None:
    ripples = [Effect.at(robot, "joint_ripple", "elbow", values=[0.001, 0.0, cycles]) for cycles in (9.0, 14.0)]
    again = load_simulation(
        write_extended(Simulation(robot, (ripples[0], ripples[1].with_ordinal(1))), tmp_path, HEADING)
    )
    assert [effect.value("cycles_per_turn") for effect in again.effects] == [9.0, 14.0]
    assert len({effect.identity for effect in again.effects}) == 2


def test_existing_file_is_replaced_only_on_request(robot, tmp_path) -> None:
    write_extended(Simulation(robot), tmp_path, HEADING)
    with pytest.raises(ConfigError, match="is there already"):
        write_extended(Simulation(robot), tmp_path, HEADING)
    write_extended(Simulation(robot), tmp_path, HEADING, replace=True)


@pytest.mark.parametrize(
    ("entry", "said", "line"),
    [
        ('effect = "joint_ofset"\nwhere = "elbow"', "Did you mean 'joint_offset'?", "joint_ofset"),
        ('where = "elbow"', "the key effect is missing", "[[effects]]"),
        ('effect = "joint_offset"\nwhere = "elbo"\noffset_rad = 0.1', "Did you mean 'elbow'?", "where ="),
        ('effect = "joint_offset"\noffset_rad = 0.1', "where is missing", "[[effects]]"),
        ('effect = "tool_offset"\nwhere = "elbow"\nx_m = 0.1', "tool_offset has no where", "where ="),
        ('effect = "joint_coupling"\nwhere = "elbow"\nratio = 0.1', "source is missing", "[[effects]]"),
        ('effect = "joint_coupling"\nwhere = "elbow"\nsource = "elbow"\nratio = 0.1', "the same joint", "source ="),
        ('effect = "joint_offset"\nwhere = "elbow"\noffset_deg = 3', "Did you mean 'offset_rad'?", "offset_deg"),
        ('effect = "joint_offset"\nwhere = "elbow"\noffset_rad = 5', "looks like degrees", "offset_rad"),
        ('effect = "joint_offset"\nwhere = "rail"\noffset_m = 5', "looks like millimetres", "offset_m"),
        ('effect = "joint_offset"\nwhere = "elbow"\noffset_rad = "5"', "is no number", "offset_rad"),
        ('effect = "joint_offset"\nwhere = "elbow"\noffset_rad = nan', "is not finite", "offset_rad"),
        (f'effect = "joint_offset"\nwhere = "elbow"\noffset_rad = {10**309}', "is not finite", "offset_rad"),
        ('effect = "joint_offset"\nwhere = "elbow"', "says of nothing how much", "[[effects]]"),
        ('effect = "joint_eccentricity"\nwhere = "rail"\nsine_m = 0.1', "joint_ripple", "where ="),
        ('effect = "camera_latency"\nlatency_s = 20', "looks like milliseconds", "latency_s"),
        ('effect = "camera_scale"\nscale_error = 2', "looks like percent", "scale_error"),
        ('effect = "encoder_jump"\nwhere = "elbow"\njump_rad = 0.1', "t0 is missing", "[[effects]]"),
        (
            'effect = "joint_ripple"\nwhere = "elbow"\nsine_rad = 0.1\ncycles_per_turn = -3',
            "cycles_per_turn = -3 cannot be",
            "cycles_per_turn",
        ),
        ('effect = "backlash"\nwhere = "elbow"\nwidth_rad = -0.1', "is never negative", "width_rad"),
        ('effect = "settling"\nwhere = "elbow"\nfraction = 0.1\nmemory = 1', "is no share", "memory"),
        ('effect = 3\nwhere = "elbow"', "is no text", "effect ="),
    ],
)
def test_an_error_names_file_line_and_remedy(tmp_path, entry, said, line) -> None:
    error = refused(tmp_path, f"\n[[effects]]\n{entry}\n")
    assert said in str(error)
    assert str(error.file).endswith("robot.toml")
    assert error.line == line_with(error, line)


def test_error_line_points_to_wrong_entry_among_several(tmp_path) -> None:
    good = '[[effects]]\neffect = "joint_offset"\nwhere = "elbow"\noffset_rad = 0.1\n'
    error = refused(tmp_path, f"{good}{good.replace('0.1', '10')}{good}")
    assert error.line == line_with(error, "offset_rad = 10")
    assert "effect 2" in error.what


def test_effects_must_be_a_list_of_tables(tmp_path) -> None:
    with pytest.raises(ConfigError, match=r"Write each effect under a heading \[\[effects\]\]"):
        extended(tmp_path, "[effects]\njoint_offset = 0.1\n")


def test_lens_effect_requires_a_stereo_camera(tmp_path) -> None:
    file = arm(tmp_path, tables="").file
    file.write_text(file.read_text() + '[[effects]]\neffect = "lens_distortion"\nk1 = 0.1\n')
    with pytest.raises(RobotError, match="needs a stereo camera"):
        load_simulation(file)


@pytest.mark.parametrize("model", [TURN.to_kbmap(BASES), TensorTrain.from_chain(TURN, BASES), kernel()], ids=type)
def test_unexplained_residual_round_trips_through_file(robot, tmp_path, model) -> None:
    unexplained = Unexplained.of(robot, model, ("elbow", "neck_tilt"))
    written = Simulation(robot, (), unexplained)
    read = load_simulation(write_extended(written, tmp_path, HEADING))
    np.testing.assert_array_equal(read.positions(walk()), written.positions(walk()))
    assert np.abs(read.positions(walk()) - Simulation(robot).positions(walk())).max() > 1e-3


@pytest.mark.parametrize(
    ("table", "said"),
    [
        ('model = "missing"\njoints = ["elbow", "rail"]', "No such file"),
        ('model = "robot.toml"\njoints = ["elbow", "rail"]', "not a map of kbmaps"),
        ('model = "good"\njoints = ["elbow"]', "takes 2 joints, not 1"),
        ('model = "good"\njoints = ["elbow", "rial"]', "Did you mean 'rail'?"),
        ('model = "good"\njoints = ["elbow", "elbow"]', "named twice"),
        ('model = "good"\njoints = ["elbow", "elbow"]\nfactors = [2.0, 2.0]', "named twice"),
        ('model = "good"\njoints = ["elbow", "rail"]\nfactors = [2.0]', "1 factors for 2 joints"),
        ('model = "good"\njoints = ["elbow", "rail"]\nfactors = [2.0, inf]', "not a finite number"),
        ('model = "good"', "joints"),
        ('model = "good"\njoints = ["elbow", "rail"]\nsize = 3', "unknown key 'size'"),
    ],
)
def test_a_wrong_table_of_the_unexplained_is_refused(tmp_path, table, said) -> None:
    (tmp_path / "good").write_bytes(TURN.to_kbmap(BASES).to_bytes())
    with pytest.raises(ConfigError, match=said):
        extended(tmp_path, f"\n[unexplained]\n{table}\n")


def test_a_residual_of_another_kind_cannot_be_stored(robot, tmp_path) -> None:
    class Bump:
        def predict(self, q):
            return np.zeros((len(q), 3))

    with pytest.raises(ValueError, match="Unexplained"):
        write_extended(Simulation(robot, (), Bump()), tmp_path, HEADING)
    assert not (tmp_path / MODEL_FILE).exists()
