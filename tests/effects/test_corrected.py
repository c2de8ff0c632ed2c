"""A corrected URDF contains all effects that a URDF can express."""

from __future__ import annotations

import numpy as np
import pytest
from effect_arms import ALL, SLIDE, arm, everywhere, sized, walk

from bodyschema.effects import Effect, Simulation, corrected_file, write_corrected
from bodyschema.robot.calibrated_files import CAMERA_LINK, MARKER_LINK
from bodyschema.robot.description import RobotDescription
from bodyschema.robot.urdf import UrdfTree, chain_between

HEADING = "made by a test"


@pytest.fixture(scope="module")
def robot(tmp_path_factory) -> RobotDescription:
    return arm(tmp_path_factory.mktemp("arm"))


def seen(robot: RobotDescription, file) -> np.ndarray:
    """Return the marker in the camera's frame, from the URDF alone."""
    chain = chain_between(
        UrdfTree.load(file),
        robot.joints,
        robot.robot.held_at,
        start=CAMERA_LINK,
        end=MARKER_LINK,
        T_start_camera=np.eye(4),
        marker_xyz=np.zeros(3),
    )
    return chain.positions(walk().q)


def test_corrected_urdf_equals_simulation_with_geometric_effects_only(robot, tmp_path) -> None:
    effects = [sized(robot, where, 2.0, k) for k, where in enumerate(everywhere(robot))]
    simulation = Simulation(robot, tuple(effects))
    wanted = Simulation(robot, tuple(effect for effect in effects if effect.kind.rigid)).positions(walk())
    file = write_corrected(simulation, tmp_path / "out", HEADING)
    np.testing.assert_allclose(seen(robot, file), wanted, rtol=0.0, atol=1e-9)


@pytest.mark.parametrize("where", [*ALL, None])
def test_effects_at_one_place_add_up(robot, tmp_path, where) -> None:
    names = ("tool_offset", "camera_pose") if where is None else ("link_geometry", "joint_offset")
    effects = tuple(sized(robot, (name, where, None), 3.0, seed) for name in names for seed in range(2))
    file = write_corrected(Simulation(robot, effects), tmp_path / "out", HEADING)
    np.testing.assert_allclose(seen(robot, file), Simulation(robot, effects).positions(walk()), rtol=0.0, atol=1e-9)


def test_rigid_chain_equals_simulation_with_geometric_effects_only(robot) -> None:
    effects = tuple(sized(robot, where, 2.0, k) for k, where in enumerate(everywhere(robot)))
    wanted = Simulation(robot, tuple(effect for effect in effects if effect.kind.rigid)).positions(walk())
    chain = Simulation(robot, effects).rigid_chain
    np.testing.assert_allclose(chain.positions(walk().q), wanted, rtol=0.0, atol=1e-9)


def test_since_matches_full_simulation_after_timed_effects(robot) -> None:
    names = ("encoder_jump", "tool_slip", "camera_moved", "camera_pose", "joint_eccentricity")
    effects = tuple(sized(robot, where, 2.0, k) for k, where in enumerate(everywhere(robot)) if where[0] in names)
    simulation, motion = Simulation(robot, effects), walk()
    after = motion.t >= 4.0
    np.testing.assert_allclose(
        simulation.since.positions(motion)[after], simulation.positions(motion)[after], rtol=0.0, atol=1e-9
    )


def test_corrected_urdf_keeps_other_joints_and_finds_meshes(robot, tmp_path) -> None:
    (tmp_path / "arm").mkdir()
    other = arm(tmp_path / "arm")
    mesh = '<visual><geometry><mesh filename="meshes/hand.stl"/></geometry></visual></link>'
    text = other.tree.file.read_text().replace("</link>", mesh, 1)
    other.tree.file.write_text(text)
    simulation = Simulation(other, (Effect.at(other, "joint_offset", SLIDE, values=[0.01]),))
    file = write_corrected(simulation, tmp_path / "out", HEADING)
    assert 'filename="../arm/meshes/hand.stl"' in file.read_text()
    tree = UrdfTree.load(file)
    for joint in other.joints:
        same = np.allclose(tree.joint(joint).T_parent_joint, other.tree.joint(joint).T_parent_joint, atol=1e-12)
        assert same == (joint != SLIDE)
    assert tree.masses.keys() >= other.tree.masses.keys()


def test_no_urdf_is_written_for_non_geometric_effects(robot, tmp_path) -> None:
    stale = tmp_path / corrected_file(robot)
    stale.write_text("of an earlier diagnosis")
    simulation = Simulation(robot, (Effect.at(robot, "joint_compliance", "elbow", values=[0.01]),))
    assert write_corrected(simulation, tmp_path, HEADING) is None
    assert not stale.exists()
