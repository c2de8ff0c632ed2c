"""A robot.toml for an arm of LeRobot: its joints, servos, IDs and zeros, from a URDF and LeRobot's calibration."""

from __future__ import annotations

import hashlib
import math
import os
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import get_args

import numpy as np

from bodyschema.cli.hardware.robot_template import CameraFindings, guess_of, key_name, robot_toml
from bodyschema.daemon.config import Config
from bodyschema.daemon.wiring.servos import KnownModel, Servos, known_models, require_servos
from bodyschema.interfaces.errors import ConfigError
from bodyschema.interfaces.servos import ScannedBus
from bodyschema.interfaces.whole_files import free_backup, link_target, raising_write_errors, replace_with_backup
from bodyschema.robot.lerobot import (
    ARMS,
    RAD_PER_TICK,
    Calibrations,
    Correction,
    JointServo,
    LeRobotArm,
    Make,
    calibration_json,
    corrections,
    read_calibration,
)
from bodyschema.robot.suggest import did_you_mean
from bodyschema.robot.toml_text import toml_value
from bodyschema.robot.urdf import MOVING, UrdfTree


class _Settings:
    baud: int = 1_000_000  # of LeRobot's arms [bit/s]
    # Where the middle of a joint's limits is nearer to 0 than this, 0 is meant to be the middle: the URDF of SO-101 has
    # wrist_roll from -157° to 163°, and LeRobot's own kinematics gives it the degrees as they are.
    middle_within_rad: float = math.radians(5.0)


Scan = Callable[[Sequence[int]], Sequence[ScannedBus]]


@dataclass(frozen=True, slots=True)
class LeRobotServo:
    joint: str
    id: int
    model: str
    direction: int
    zero_ticks: float
    middle_rad: float  # the joint's angle at LeRobot's 0° [rad]


def lerobot_arm(name: str) -> LeRobotArm:
    """Return the arm that LeRobot calls `name`; raise ConfigError if its motors are unknown."""
    if name not in ARMS:
        raise ConfigError(f"--lerobot {name}: the motors of this arm are not known", remedy=did_you_mean(name, ARMS))
    return ARMS[name]


def lerobot_robot_toml(
    arm: LeRobotArm, urdf: Path, robot: Path, calibration: Path, port: str, seen: CameraFindings
) -> str:
    """Return the text of a robot.toml for `arm`.

    Args:
        robot: the file to be written; the URDF is named relative to it.
        calibration: LeRobot's file of this arm.
        port: port of its servos.

    Raises:
        ConfigError: the URDF has other joints, or the calibration is not of this arm.
    """
    tree = UrdfTree.load(urdf)
    guess = guess_of(tree, os.path.relpath(urdf, robot.parent), _end(tree, arm.joints))._replace(
        name=key_name(calibration.stem)
    )
    servos = _servos(arm, tree, read_calibration(calibration, arm.joints), calibration)
    # LeRobot's arms have these joints and links, and the camera's pose is fitted.
    known = "# CHECK: " if seen.webcam else "# CHECK: (?!the cameras;)"
    text = re.sub(f"{known}(.)", lambda found: f"# {found[1].upper()}", robot_toml(guess, seen))
    return text + _servo_tables(arm, servos, calibration, port)


def lerobot_port(arm: LeRobotArm, scan: Scan) -> str:
    """Return the only port that has all motors of `arm`; raise ConfigError if none or more than one has."""
    expected = {(arm.id(name), arm.models[name]) for name in arm.joints}
    scanned = scan([_Settings.baud])
    found = [bus.port for bus in scanned if expected <= {(servo.id, servo.model) for servo in bus.servos}]
    if len(found) == 1:
        return found[0]
    if found:
        raise ConfigError(
            f"such arms are on {' and '.join(found)}", remedy="Give --port with the one to take, leader or follower"
        )
    scanned_ids = ", ".join(f"{bus.port} has {_ids(bus)}" for bus in scanned)
    raise ConfigError(
        f"no port has servos {', '.join(f'ID {id} ({model})' for id, model in sorted(expected))}: {scanned_ids}",
        remedy="Switch the arm's supply on, or give --port",
    )


def joint_servos(servos: Servos) -> list[JointServo]:
    """Return the conversion of each joint, from the servos of robot.toml."""
    known, found = known_models(), list[JointServo]()
    for servo in servos.servos:
        model = known[servo.model]
        zero = model.zero_ticks if servo.zero_ticks is None else servo.zero_ticks
        found.append(JointServo(servo.joint, _make(model), servo.direction, zero))
    return found


def _make(model: KnownModel) -> Make:
    for make in get_args(Make):
        if make == model.table:
            return make
    raise ConfigError(f"LeRobot has no arms with servos of {model.table}")


def _ids(bus: ScannedBus) -> str:
    return ", ".join(f"ID {servo.id} ({servo.model})" for servo in bus.servos) or "none"


def _end(tree: UrdfTree, joints: Sequence[str]) -> str:
    """Return the farthest link that the last of `joints` moves without any joint beyond it."""
    missing = [joint for joint in joints if joint not in tree.joints]
    if missing:
        raise ConfigError(
            f"has no joint {', '.join(missing)}; it has {', '.join(tree.joints)}",
            file=tree.file,
            remedy="Rename the URDF's joints to LeRobot's motors",
        )
    start, ends = tree.joints[joints[-1]].child, list[tuple[int, str]]()
    for link in tree.links:
        joints_between = tree.path(start, link)
        if all(not upward and joint.kind not in MOVING for joint, upward in joints_between):
            ends.append((len(joints_between), link))
    return max(ends, key=lambda end: end[0])[1]


def _servos(arm: LeRobotArm, tree: UrdfTree, calibrations: Calibrations, file: Path) -> list[LeRobotServo]:
    found: list[LeRobotServo] = []
    for name in arm.joints:
        joint, motor = tree.joints[name], calibrations[name]
        if motor.id != arm.id(name):
            raise ConfigError(
                f"{name} has ID {motor.id}, and LeRobot gives it ID {arm.id(name)}",
                file=file,
                remedy="Give the calibration of this kind of arm",
            )
        direction = -1 if arm.make == "feetech" and motor.drive_mode else 1
        middle = _middle_rad(joint.lower, joint.upper)
        zero = motor.middle - direction * middle / RAD_PER_TICK
        zero = zero if middle == 0.0 else round(zero)
        found.append(LeRobotServo(name, motor.id, arm.models[name], direction, zero, middle))
    return found


def _middle_rad(lower: float, upper: float) -> float:
    """Return the angle of a joint with these limits at LeRobot's 0° [rad]."""
    middle = (lower + upper) / 2
    return 0.0 if abs(middle) < _Settings.middle_within_rad else middle


def _servo_tables(arm: LeRobotArm, servos: Sequence[LeRobotServo], calibration: Path, port: str) -> str:
    table = f"drivers.{arm.make}"
    lines = [
        "",
        f"# The servos, with IDs and zeros from LeRobot's {calibration.name}: 0 is the middle of the recorded range.",
        "# CHECK directions with `bodyschema watch joints`: move a joint, and look where its angle goes.",
        f"[{table}.buses.arm]",
        f"port = {toml_value(port)}",
        f"baud = {_Settings.baud:_}",
        "",
    ]
    for servo in servos:
        check = ""
        if servo.middle_rad:
            check = f"  # CHECK: taken from the middle of the URDF's limits, {math.degrees(servo.middle_rad):.0f}°"
        lines += [
            f"[[{table}.servos]]",
            f"joint = {toml_value(servo.joint)}",
            f"id = {servo.id}",
            f"model = {toml_value(servo.model)}",
            f"direction = {servo.direction}",
            f"zero_ticks = {servo.zero_ticks:.5g}{check}",
            "",
        ]
    return "\n".join(lines)


RECORDINGS = ".recordings"


@dataclass(frozen=True)
class CorrectedCalibration:
    """A calibration file that contains the offsets."""

    file: Path  # LeRobot's
    motors: Calibrations  # all motors with their new values
    changes: tuple[Correction, ...]  # the change of each motor
    warnings: tuple[str, ...] = ()

    @classmethod
    def of(cls, config: Config, file: Path, offsets_rad: Mapping[str, float]) -> CorrectedCalibration:
        """Add joint offsets [rad], which are to be added to the readings, to the calibration in `file`.

        Raises:
            ConfigError: robot.toml has no servos, or the file does not belong to them.
        """
        servos = joint_servos(require_servos(config))
        motors = read_calibration(file, [servo.joint for servo in servos])
        changes = tuple(corrections(motors, servos, offsets_rad))
        after = motors | {change.motor: change.after for change in changes}
        return cls(file, after, changes, _other_zeros(config, servos, motors, file))

    def already_written(self, recording: Path | None) -> list[str]:
        """Return a message if the file already contains the offsets of this recording, otherwise nothing."""
        digest = _digest(recording)
        backups = [
            line.split("\t")[1] for line in self._noted_recordings().splitlines() if line.startswith(f"{digest}\t")
        ]
        if recording is None or not backups:
            return []
        target = link_target(self.file)
        backup, noted = target.with_name(backups[-1]), target.with_name(target.name + RECORDINGS)
        return [
            f"{self.file} already has the offsets of {recording.name} in it ({backup} is the file without them). "
            f"Record again with the new calibration; or delete {noted} to write all the same."
        ]

    def write(self, recording: Path | None = None) -> Path:
        """Replace the file, and keep the old one beside it; return the name of the old one.

        Args:
            recording: the recording of the offsets, to be noted beside the calibration.

        Raises:
            ConfigError: nothing could be written.
        """
        extra_files = dict[str, bytes]()
        if recording is not None and (digest := _digest(recording)):
            backup = free_backup(link_target(self.file))
            noted = f"{digest}\t{backup.name}\t{recording.name}\n"
            extra_files[RECORDINGS] = (self._noted_recordings() + noted).encode(errors="surrogateescape")
        with raising_write_errors(self.file):
            return replace_with_backup(self.file, calibration_json(self.motors).encode(), extra_files)

    def _noted_recordings(self) -> str:
        """Return a line for each recording whose offsets are in the file: digest, name of the old file, recording."""
        target = link_target(self.file)
        try:
            noted = target.with_name(target.name + RECORDINGS).read_bytes()
        except OSError:
            return ""
        return noted.decode(errors="surrogateescape")


def _other_zeros(config: Config, servos: Sequence[JointServo], motors: Calibrations, file: Path) -> tuple[str, ...]:
    """Return a warning if robot.toml was not written from this calibration, by the zeros of its servos."""
    limits = dict(zip(config.robot.joints, zip(config.robot.lower, config.robot.upper, strict=True), strict=True))
    read = [
        (servo.joint, float(servo.angles(np.array(motors[servo.joint].middle))), _middle_rad(*limits[servo.joint]))
        for servo in servos
        if servo.joint in limits
    ]
    other = [
        f"{joint} reads {math.degrees(angle):.1f}° and not {math.degrees(middle):.1f}°"
        for joint, angle, middle in read
        if abs(angle - middle) > RAD_PER_TICK
    ]
    if not other:
        return ()
    return (
        f"{config.file.name} has other zeros than {file.name}: in the middle of its range {', '.join(other)}. If the "
        "arm was calibrated again, or this is another arm's file, write robot.toml again: `bodyschema init --lerobot`.",
    )


def _digest(recording: Path | None) -> str | None:
    """Return the SHA-256 of a recording in one file; None for any other."""
    if recording is None or not recording.is_file():
        return None
    digest = hashlib.sha256()
    recent = recording.with_name(f"{recording.name}-wal")  # SQLite's file of data not yet moved into a store
    try:
        for file in (recording, recent):
            if file is recording or file.is_file():
                with file.open("rb") as stream:
                    hashlib.file_digest(stream, lambda: digest)
    except OSError:
        return None
    return digest.hexdigest()


def difference(corrected: CorrectedCalibration) -> list[str]:
    """Return lines that show the changes of the file."""
    file, changes = corrected.file, [change for change in corrected.changes if change.ticks]
    if not changes:
        return [
            f"{file}: no joint offset is as large as one tick ({math.degrees(RAD_PER_TICK):.3f}°). Nothing to write"
        ]
    width = max(len(change.motor) for change in changes)
    lines = [f"{file}:"]
    lines += [
        f"  {change.motor:{width}}  homing_offset {change.before.homing_offset} → {change.after.homing_offset}"
        f"  (readings {math.degrees(change.offset_rad):+.3f}°)"
        for change in changes
    ]
    return [*lines, _of_ranges(changes), *corrected.warnings]


def after_writing(backup: Path) -> str:
    """Return the steps to take after the file is written."""
    return (
        f"Written; the old file is {backup}. Start LeRobot, and press ENTER where it offers to write the calibration "
        "file to the motors. From then on the readings have the offsets in them, so keep robot.toml and its URDF."
    )


def _of_ranges(changes: Sequence[Correction]) -> str:
    largest = max(changes, key=lambda change: abs(change.ticks))
    degrees = abs(largest.ticks) * math.degrees(RAD_PER_TICK)
    return (
        f"The range ends shift with the zeros, {largest.motor} by {degrees:.1f}°: "
        "drive there slowly the first time. Datasets and policies from before have the old offsets."
    )
