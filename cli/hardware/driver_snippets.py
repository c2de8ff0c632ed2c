"""Express the results in drivers' terms: ros2_control, Universal Robots' kinematics.yaml, servo zeros in ticks."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from bodyschema.daemon.config import Config
from bodyschema.effects import Simulation
from bodyschema.effects.exports.arm_errors import ArmErrors, geometry_of
from bodyschema.effects.joint_errors import JointErrors
from bodyschema.robot.rpy import rpy_of

# ur_description, from the base outwards: the joint's name without prefix, and its link's name in kinematics.yaml.
_UR = {
    "shoulder_pan_joint": "shoulder",
    "shoulder_lift_joint": "upper_arm",
    "elbow_joint": "forearm",
    "wrist_1_joint": "wrist_1",
    "wrist_2_joint": "wrist_2",
    "wrist_3_joint": "wrist_3",
}
# 1 if a servo adds its Homing Offset to the sensor reading, -1 if it subtracts it.
_HOMING_SIGN = {"dynamixel": 1, "feetech": -1}
_ONCE = "Correct a zero in one place only: a driver that has it, and extended.toml beside it, count it twice."


_LEROBOT = (
    "  (LeRobot's homing_offset is the Homing Offset: "
    "`bodyschema calibrate RECORDING --only offsets --lerobot FILE --write` puts it into its file)"
)
IN_DRIVERS = frozenset({"joint_offset", "joint_scale"})


def write_snippets(simulation: Simulation, file: Path, heading: str) -> list[str]:
    """Write the part of the simulation that drivers can represent to `file`, as text to copy from.

    Returns:
        Sentences on what no driver can represent.

    Raises:
        ConfigError: robot.toml has an invalid table.
        OSError: the file cannot be written.
    """
    errors = ArmErrors.of(simulation)
    with_ratios = {name: joint for name, joint in errors.joints.items() if joint.offset or name in joint.ratios}
    parts = [f"{heading}\n{_ONCE}", _zeros(with_ratios), _ros2_control(with_ratios)]
    parts += [*_servos(simulation, with_ratios), *_kinematics(errors)]
    file.write_text("\n\n".join(parts) + "\n", encoding="utf-8")
    others = {effect.name for effect in errors.simulation.all_effects} - IN_DRIVERS
    return [f"in no driver's settings: {', '.join(sorted(others))}; correction.json has them"] if others else []


def _zeros(joints: dict[str, JointErrors]) -> str:
    lines = ["Joints: true value = reading · (1 + scale error) + offset"]
    for name, joint in joints.items():
        degrees = math.degrees(joint.offset)
        scale = joint.ratios.get(name, 0.0)
        lines.append(f"  {name}: offset {joint.offset:+.6f} rad ({degrees:+.3f} deg), scale error {scale:+.6f}")
    return "\n".join(lines if joints else ["Joints: no zero and no scale was found wrong."])


def _ros2_control(joints: dict[str, JointErrors]) -> str:
    lines = ["ros2_control: inside <ros2_control>, where the hardware component loads transmissions"]
    for name, joint in joints.items():
        lines += [
            f'  <transmission name="{name}_transmission">',
            "    <plugin>transmission_interface/SimpleTransmission</plugin>",
            f'    <actuator name="{name}_actuator" role="actuator1"/>',
            f'    <joint name="{name}" role="joint1">',
            f"      <mechanical_reduction>{1.0 / (1.0 + joint.ratios.get(name, 0.0))!r}</mechanical_reduction>",
            f"      <offset>{joint.offset!r}</offset>",
            "    </joint>",
            "  </transmission>",
        ]
    return "\n".join(lines) if joints else "ros2_control: nothing to change."


def _servos(simulation: Simulation, joints: dict[str, JointErrors]) -> Iterator[str]:
    """Yield zeros in ticks, where robot.toml names the servos."""
    drivers = Config.load(simulation.robot.file).tables.drivers
    for make, sign in _HOMING_SIGN.items():
        table = getattr(drivers, make)
        if table is None:
            continue
        lines = [f"{make}: one of the two, in ticks; then torque off, and `bodyschema servos`", _LEROBOT]
        for servo in table.servos:
            if servo.joint not in joints or not joints[servo.joint].offset:
                continue
            model = table.model_of(servo)
            moved = servo.direction * joints[servo.joint].offset / model.rad_per_tick
            zero = model.zero_ticks if servo.zero_ticks is None else servo.zero_ticks
            left = math.degrees(abs(moved - round(moved)) * model.rad_per_tick)
            line = f"  {servo.joint} (ID {servo.id}, {model.name}): zero_ticks = {zero - round(moved)} in robot.toml"
            if "homing_offset" in model.layout.registers:
                line += f", or {sign * round(moved):+d} on its Homing Offset"
            lines.append(f"{line} ({left:.3f} deg left over by rounding)")
        yield "\n".join(lines)


def _kinematics(errors: ArmErrors) -> Iterator[str]:
    """Yield Universal Robots' own file, for arms whose joints are called as in ur_description."""
    robot = errors.simulation.robot
    found = {name: link for name in robot.joints for end, link in _UR.items() if name.endswith(end)}
    if list(found.values()) != list(_UR.values()):
        return
    geometry = geometry_of(errors.simulation)
    lines = [
        "UR kinematics.yaml, for ur_description's kinematics_params (zeros are in it, scales are not)",
        "kinematics:",
    ]
    for name, link in found.items():
        T = geometry.T_parent_joint.get(name, robot.tree.joint(name).T_parent_joint)
        numbers = np.concatenate([T[:3, 3], rpy_of(T[:3, :3])])
        lines.append(f"  {link}:")
        lines += [
            f"    {key}: {value!r}"
            for key, value in zip(("x", "y", "z", "roll", "pitch", "yaw"), numbers.tolist(), strict=True)
        ]
    yield "\n".join([*lines, f"  hash: calib_{robot.name}"])
