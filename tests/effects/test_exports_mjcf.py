"""MuJoCo puts the marker of an exported model at the simulation's position."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from effect_arms import arm, everywhere, sized, walk
from public_arms import ARMS, public_arm, readings

from bodyschema.effects import EFFECT_TYPES, Effect, Motion, Parameter, Simulation
from bodyschema.effects.encoder import EncoderEffect
from bodyschema.effects.exports import replayed, write_correction, write_mjcf
from bodyschema.interfaces.errors import RobotError
from bodyschema.interfaces.records import FloatArray
from bodyschema.robot.description import RobotDescription

mujoco = pytest.importorskip("mujoco")

# Values that a joint in the middle of the chain has, one effect at a time; `t0` lies before the first row.
EFFECTS = {
    "joint_offset": [0.03],
    "joint_scale": [0.01],
    "joint_eccentricity": [0.01, -0.015],
    "joint_ripple": [0.004, 0.003, 8.0],
    "joint_coupling": [0.02],
    "encoder_jump": [0.02, -1.0],
    "backlash": [0.01],
    "joint_compliance": [0.001],
    "gravity_backlash": [0.01, 0.1],
    "link_geometry": [0.004, -0.003, 0.002, 0.01, -0.02, 0.015],
    "tool_offset": [0.01, -0.02, 0.005],
    "tool_slip": [0.004, 0.0, 0.003, -1.0],
    "camera_pose": [0.01, 0.02, -0.01, 0.01, 0.0, 0.02],
    "camera_moved": [0.0, 0.005, 0.0, 0.0, 0.01, 0.0, -1.0],
}
PAYLOAD = [1.2, 0.03, -0.02, 0.04]
CLOSE_M = 1e-4
# Slow enough for the arm not to swing, and long enough for springs to come to rest.
MOVE_S, REST_S, STIFF = 1.0, 1.0, [0.9999, 0.9999, 0.001, 0.5, 2.0]


@pytest.fixture(autouse=True)
def in_a_folder_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Change to a temporary folder: MuJoCo writes its warnings to a file in the current one."""
    monkeypatch.chdir(tmp_path)


def effect(robot, name: str) -> Effect:
    joint = Effect.at(robot, "joint_offset", robot.joints[1]).where
    kind = name in ("tool_offset", "tool_slip", "camera_pose", "camera_moved")
    source = robot.joints[3] if name == "joint_coupling" else None
    return Effect.at(robot, name, None if kind else joint, source, EFFECTS[name])


def stepped(file: Path, joints: tuple[str, ...], motion: Motion) -> FloatArray:
    """Return the marker positions of MuJoCo's dynamics, with the read joints driven from row to row."""
    spec = mujoco.MjSpec.from_file(str(file))
    for actuator in list(spec.actuators):
        spec.delete(actuator)
    for name in joints:
        kinds = {"type": mujoco.mjtEq.mjEQ_JOINT, "objtype": mujoco.mjtObj.mjOBJ_JOINT}
        spec.add_equality(name=f"held {name}", name1=name, solref=[0.004, 1.0], solimp=STIFF, **kinds)
    model = spec.compile()
    data = mujoco.MjData(model)
    held = [model.equality(f"held {name}").id for name in joints]
    read = [model.joint(name).qposadr[0] for name in joints]
    zero, found = model.qpos0[read], []
    # A backlash starts on the side of the first move: it is approached from there.
    last = motion.q[0] - 0.05 * np.sign(motion.q[1] - motion.q[0])
    data.qpos[read] = last
    for row in motion.q:
        steps = round(MOVE_S / model.opt.timestep)
        for way in 0.5 - 0.5 * np.cos(np.pi * np.arange(1, steps + 1) / steps):
            model.eq_data[held, 0] = last + way * (row - last) - zero
            mujoco.mj_step(model, data)
        mujoco.mj_step(model, data, round(REST_S / model.opt.timestep))
        seen = data.site("measurement_frame")
        found.append((data.site("marker").xpos - seen.xpos) @ seen.xmat.reshape(3, 3))
        last = row
    return np.array(found)


def farthest(x: FloatArray, wanted: FloatArray) -> float:
    return float(np.linalg.norm(x - wanted, axis=1).max())


@pytest.mark.parametrize("arm_name", list(ARMS))
def test_marker_agrees_effect_by_effect(arm_name: str, tmp_path: Path) -> None:
    robot, file = public_arm(arm_name, tmp_path), tmp_path / "model.xml"
    motion, apart = readings(robot, 8), {}
    for name in EFFECTS:
        simulation = Simulation(robot, (effect(robot, name),))
        write_mjcf(simulation, file, "made by a test")
        wanted = simulation.positions(motion)
        apart[name] = farthest(replayed(file, robot.joints, motion), wanted)
        assert farthest(Simulation(robot).positions(motion), wanted) > 10.0 * CLOSE_M
    assert {name: mm for name, mm in apart.items() if mm > CLOSE_M} == {}


@pytest.mark.parametrize("arm_name", list(ARMS))
@pytest.mark.parametrize(
    "names", [("joint_compliance",), tuple(name for name in EFFECTS if name != "joint_compliance")]
)
def test_dynamics_come_to_rest_there(arm_name: str, names: tuple[str, ...], tmp_path: Path) -> None:
    robot, file = public_arm(arm_name, tmp_path), tmp_path / "model.xml"
    simulation, motion = Simulation(robot, tuple(effect(robot, name) for name in names)), readings(robot, 4)
    write_mjcf(simulation, file, "made by a test")
    assert farthest(stepped(file, robot.joints, motion), simulation.positions(motion)) < CLOSE_M


def test_every_joint_agrees_on_an_arm_with_everything(tmp_path: Path) -> None:
    robot, motion, file = arm(tmp_path), walk(rows=40), tmp_path / "model.xml"
    places = [where for where in everywhere(robot) if where[0] in EFFECTS]
    # Without a clear load, the side of a loose joint is decided by rounding.
    loads = dict(zip(robot.joints, np.abs(Simulation(robot).torques(motion.q)).min(axis=0), strict=True))
    places = [where for where in places if where[0] != "gravity_backlash" or loads[str(where[1])] > 1.0]
    effects = [sized(robot, where, 0.3, k) for k, where in enumerate(places)]
    began = [e.with_values(np.append(e.values[:-1], -1.0)) if e.kind.begins else e for e in effects]
    simulation = Simulation(robot, tuple(began))
    write_mjcf(simulation, file, "made by a test")
    assert farthest(replayed(file, robot.joints, motion), simulation.positions(motion)) < CLOSE_M


def test_a_payload_loads_the_springs(tmp_path: Path) -> None:
    robot, file = public_arm("xarm6", tmp_path), tmp_path / "model.xml"
    spring, payload = effect(robot, "joint_compliance"), Effect.at(robot, "payload", values=PAYLOAD)
    simulation, motion = Simulation(robot, (spring, payload)), readings(robot, 8)
    write_mjcf(simulation, file, "made by a test")
    wanted = simulation.positions(motion)
    assert farthest(replayed(file, robot.joints, motion), wanted) < CLOSE_M
    assert farthest(Simulation(robot, (spring,)).positions(motion), wanted) > 10.0 * CLOSE_M


@pytest.mark.parametrize("name", list(EFFECT_TYPES))
def test_effects_unsupported_by_mjcf_are_listed(name: str, tmp_path: Path) -> None:
    robot, file = arm(tmp_path), tmp_path / "model.xml"
    where = next(where for where in everywhere(robot) if where[0] == name and where[1] != "rail")
    told = write_mjcf(Simulation(robot, (sized(robot, where, 1.0),)), file, "made by a test")
    listed = any(sentence.startswith("not in the file: " + name) for sentence in told)
    assert listed == (name not in {*EFFECTS, "payload"})
    assert listed == (f'<numeric name="{name}' in file.read_text())
    assert all(sentence in file.read_text() for sentence in told)


def test_the_camera_has_the_calibrated_focal_length(tmp_path: Path) -> None:
    write_mjcf(Simulation(arm(tmp_path)), tmp_path / "model.xml", "made by a test")
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "model.xml"))
    pixel = model.cam_sensorsize[0] / model.cam_resolution[0]
    np.testing.assert_allclose(model.cam_intrinsic[0, :2] / pixel, 700.0, rtol=1e-6)


def test_meshes_are_kept_and_missing_ones_are_listed(tmp_path: Path) -> None:
    robot, file = public_arm("iiwa", tmp_path), tmp_path / "model.xml"
    assert write_mjcf(Simulation(robot), file, "made by a test") == []
    assert mujoco.MjModel.from_xml_path(str(file)).nmesh > 6
    copy = tmp_path / "copy.urdf"
    copy.write_bytes(robot.tree.file.read_bytes())
    robot.file.write_text(robot.file.read_text().replace(str(robot.tree.file), "copy.urdf"))
    told = write_mjcf(Simulation(RobotDescription.load(robot.file)), file, "made by a test")
    assert "meshes" in told[0]
    model = mujoco.MjModel.from_xml_path(str(file))
    assert (model.nmesh, model.ngeom > 5) == (0, True)


class NewEffect(EncoderEffect):
    name = "new_effect"

    def parameters(self, prismatic: bool) -> tuple[Parameter, ...]:
        return (Parameter("size_rad", 0.1),)

    def columns(self, motion, place, values):
        return np.square(motion.q[:, [place.joint]])


@pytest.mark.parametrize(("write", "name"), [(write_mjcf, "model.xml"), (write_correction, "correction.json")])
def test_effects_that_are_not_known_are_listed(write, name: str, tmp_path: Path) -> None:
    robot = arm(tmp_path)
    new = Effect(NewEffect(), "elbow", None, np.array([0.1]))
    [told] = write(Simulation(robot, (new,)), tmp_path / name, "made by a test")
    assert told.startswith("not in the file: new_effect at elbow")


def test_springs_that_the_hand_relieved_are_left_out(tmp_path: Path) -> None:
    robot, file = arm(tmp_path, hold="torque_free"), tmp_path / "model.xml"
    [told] = write_mjcf(Simulation(robot, (effect(robot, "joint_compliance"),)), file, "made by a test")
    assert "guiding hand" in told
    assert not mujoco.MjModel.from_xml_path(str(file)).jnt_stiffness.any()


def test_wrong_urdf_number_is_reported_with_its_line(tmp_path: Path) -> None:
    robot = arm(tmp_path)
    robot.tree.file.write_text(robot.tree.file.read_text().replace('ixx="0.01"', 'ixx="much"', 1))
    with pytest.raises(RobotError, match=r"everything\.urdf, line 1: link .base.*much"):
        write_mjcf(Simulation(robot), tmp_path / "model.xml", "made by a test")
