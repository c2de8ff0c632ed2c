"""Export a robot with its effects to files of other programs, and measure the improvement on recorded data."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np
from msgspec import Meta

from bodyschema.cli.recordings.diagnosis import DIAGNOSIS
from bodyschema.daemon.config import Config
from bodyschema.diagnosis.fit.alignment import aligned
from bodyschema.diagnosis.fit.observations import Observations
from bodyschema.effects import Motion, Simulation
from bodyschema.effects.exports import corrected, replayed, write_correction, write_mjcf, write_urdf
from bodyschema.effects.exports.arm_errors import ArmErrors, geometry_of
from bodyschema.effects.exports.replay import mujoco_version
from bodyschema.effects.files import EXTENDED_FILE
from bodyschema.effects.joint_errors import JointErrors
from bodyschema.interfaces.errors import ConfigError
from bodyschema.interfaces.records import FloatArray
from bodyschema.interfaces.whole_files import require_target
from bodyschema.recordings.recording import Recording
from bodyschema.robot.calibrated_files import CAMERA_LINK, MARKER_LINK
from bodyschema.robot.limited import read_at_most
from bodyschema.robot.rpy import rpy_of
from bodyschema.robot.urdf import UrdfTree, chain_between

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
        Sentences on the effects that no driver can represent.

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
    """Yield zeros in ticks, if robot.toml names the servos."""
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
    """Yield Universal Robots' own file, for arms whose joints have the names of ur_description."""
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


MJCF, URDF, CORRECTION, DRIVERS = ".xml", ".urdf", ".json", ".txt"


def _write_correction(simulation: Simulation, file: Path, heading: str) -> list[str]:
    """Write correction.json with the covariance of poses from the diagnosis.json beside extended.toml, if any."""
    found, known = simulation.robot.file.with_name(DIAGNOSIS), None
    if simulation.robot.file.name == EXTENDED_FILE and found.is_file():
        try:
            known = msgspec.json.decode(read_at_most(found), type=_Known).pose_covariance
        except (OSError, msgspec.DecodeError) as error:
            raise ConfigError(f"is not what diagnose wrote: {error}", file=found, remedy="Diagnose again") from error
    lines = write_correction(simulation, file, heading, known)
    if known is None:
        lines.append(
            f"not in it: the pose's covariance, which {DIAGNOSIS} beside {EXTENDED_FILE} has if anything was fitted"
        )
    return lines


class _Known(msgspec.Struct, frozen=True):
    """The part of diagnosis.json that a correction needs."""

    pose_covariance: Annotated[list[float], Meta(min_length=36, max_length=36)] | None = None


_WRITERS: dict[str, Callable[[Simulation, Path, str], list[str]]] = {
    MJCF: write_mjcf,
    URDF: write_urdf,
    CORRECTION: _write_correction,
    DRIVERS: write_snippets,
}
_WITHOUT_MUJOCO = "Not replayed: MuJoCo is not installed (pip install mujoco)"


def check_target(out: Path, *, force: bool) -> None:
    """Raise ConfigError unless a robot can be written to `out`: its ending is known and no file is in the way."""
    require_target(out, _WRITERS, "a robot's files", force=force, error=ConfigError)


def write(simulation: Simulation, out: Path) -> list[str]:
    """Write the simulation in the format of the ending of `out`. The file appears once it is complete.

    Returns:
        Sentences on effects that the file does not represent, or represents differently.

    Raises:
        ConfigError: the file cannot be written.
    """
    part = out.with_name(f".{out.stem}.part{out.suffix}")
    heading = f"{simulation.robot.name}, by bodyschema {version('bodyschema')} from {simulation.robot.file.name}"
    try:
        lines = _WRITERS[out.suffix.lower()](simulation, part, heading)
        os.replace(part, out)
    except OSError as error:
        raise ConfigError(f"cannot be written: {error.strerror or error}", file=out) from error
    finally:
        part.unlink(missing_ok=True)
    return lines


def effects_of(simulation: Simulation) -> str:
    """Return the number of effects of a simulation; those within tolerance of links and drives are counted apart."""
    count, small = len(simulation.effects), len(simulation.background)
    summary = "without effects" if not count else f"with {count} effect{'s' if count > 1 else ''}"
    return f"{summary} and {small} small error{'s' if small > 1 else ''} within tolerance" if small else summary


@dataclass(frozen=True)
class Row:
    """Errors of one model on measured positions."""

    model: str  # its name
    # rms_mm, mean_mm: RMS and mean of the distances to the measured positions
    rms_mm: float
    mean_mm: float
    gain_percent: float | None  # reduction of the RMS relative to the nominal model; None for that one


def compared(simulation: Simulation, recording: Recording, out: Path) -> tuple[list[Row], str | None]:
    """Return the errors of the nominal model, the simulation and the exported file on a recording.

    The nominal model is the robot as described; unknowns of camera and marker in robot.toml are fitted for it.

    Returns:
        The rows, and the reason if the exported file is not among them.
    """
    motion = Motion.of(recording)
    bare = Simulation(simulation.robot)
    predicted = {
        "nominal": aligned(Observations.of(recording, bare), bare).predicted,
        "bodyschema simulate": simulation.positions(motion),
    }
    why_not = None
    if out.suffix.lower() == MJCF:
        version_ = mujoco_version()
        if version_ is None:
            why_not = _WITHOUT_MUJOCO
        else:
            predicted[f"{out.name} in MuJoCo {version_}"] = replayed(out, simulation.robot.joints, motion)
    elif out.suffix.lower() == DRIVERS:
        # Beside the fit of camera and marker, which changes no background.
        kept = tuple(effect for effect in simulation.with_permanent_changes.all_effects if effect.name in IN_DRIVERS)
        settings = Simulation(simulation.robot, (), None, kept)
        predicted[f"zeros and scales of {out.name}"] = aligned(Observations.of(recording, settings), settings).predicted
    elif out.suffix.lower() == CORRECTION:
        predicted[out.name] = corrected(out, motion)
    else:
        predicted[out.name] = _seen_by_urdf(out, simulation, motion.q)
    return _rows(predicted, recording.x), why_not


def _rows(predicted: dict[str, FloatArray], x: FloatArray) -> list[Row]:
    rows: list[Row] = []
    for model, positions in predicted.items():
        distance = 1e3 * np.linalg.norm(positions - x, axis=1)
        rms = float(np.sqrt(np.square(distance).mean()))
        gain = 100.0 * (1.0 - rms / rows[0].rms_mm) if rows and rows[0].rms_mm else None
        rows.append(Row(model, rms, float(distance.mean()), gain))
    return rows


def _seen_by_urdf(file: Path, simulation: Simulation, q: FloatArray) -> FloatArray:
    robot, none = simulation.robot, np.zeros(3)
    chain = chain_between(
        UrdfTree.load(file),
        robot.joints,
        robot.robot.held_at,
        start=CAMERA_LINK,
        end=MARKER_LINK,
        T_start_camera=np.eye(4),
        marker_xyz=none,
    )
    return chain.positions(q)
