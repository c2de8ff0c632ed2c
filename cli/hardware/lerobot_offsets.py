"""Joint offsets that were found, put into LeRobot's calibration file."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from bodyschema.daemon.config import Config
from bodyschema.daemon.wiring.servos import require_servos
from bodyschema.interfaces.errors import ConfigError
from bodyschema.robot.lerobot import (
    RAD_PER_TICK,
    Calibrations,
    Correction,
    calibration_json,
    corrections,
    read_calibration,
)

from .lerobot_robot import joint_servos

BACKUP = ".before"


@dataclass(frozen=True)
class CorrectedCalibration:
    """A calibration file with the offsets in it.

    Attributes:
        file: LeRobot's.
        motors: all motors as they would be written.
        changes: what is put into which motor.
    """

    file: Path
    motors: Calibrations
    changes: tuple[Correction, ...]

    @classmethod
    def of(cls, config: Config, file: Path, offsets_rad: Mapping[str, float]) -> CorrectedCalibration:
        """Put offsets, which are to be added to the joints' readings [rad], into the calibration in `file`.

        Raises:
            ConfigError: robot.toml has no servos, or the file is not of them.
        """
        servos = joint_servos(require_servos(config))
        motors = read_calibration(file, [servo.joint for servo in servos])
        changes = tuple(corrections(motors, servos, offsets_rad))
        return cls(file, motors | {change.motor: change.after for change in changes}, changes)

    def write(self) -> Path:
        """Replace the file, and keep the old one beside it; return the name of the old one.

        Raises:
            ConfigError: nothing could be written.
        """
        backup = _free_name(self.file)
        part = self.file.with_name(f".{self.file.name}.part")
        try:
            part.write_text(calibration_json(self.motors), encoding="utf-8")
            backup.write_bytes(self.file.read_bytes())
            os.replace(part, self.file)
        except OSError as error:
            raise ConfigError(f"cannot be written: {error.strerror}", file=self.file) from error
        finally:
            part.unlink(missing_ok=True)
        return backup


def _free_name(file: Path) -> Path:
    """Return a name for the old file that nothing has yet."""
    count, name = 1, file.with_name(f"{file.name}{BACKUP}")
    while name.exists():
        count += 1
        name = file.with_name(f"{file.name}{BACKUP}{count}")
    return name


def difference(corrected: CorrectedCalibration) -> list[str]:
    """Return the lines that show what changes in the file."""
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
    return [*lines, _of_ranges(changes)]


def after_writing(backup: Path) -> str:
    """Return what to do once the file is written."""
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
