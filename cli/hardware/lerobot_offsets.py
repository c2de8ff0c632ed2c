"""Joint offsets that were found, put into LeRobot's calibration file."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from bodyschema.daemon.config import Config
from bodyschema.daemon.wiring.servos import require_servos
from bodyschema.interfaces.errors import ConfigError
from bodyschema.interfaces.whole_files import free_backup, link_target, replace_kept
from bodyschema.robot.lerobot import (
    RAD_PER_TICK,
    Calibrations,
    Correction,
    calibration_json,
    corrections,
    read_calibration,
)

from .lerobot_robot import joint_servos

RECORDINGS = ".recordings"


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

    def already(self, recording: Path | None) -> list[str]:
        """Return what to say where the offsets of this recording are in the file already; else nothing."""
        digest = _digest(recording)
        backups = [line.split("\t")[1] for line in self._noted().splitlines() if line.startswith(f"{digest}\t")]
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
            recording: the file in which the offsets were found, to be noted beside the calibration.

        Raises:
            ConfigError: nothing could be written.
        """
        beside = dict[str, bytes]()
        if recording is not None and (digest := _digest(recording)):
            backup = free_backup(link_target(self.file))
            noted = f"{digest}\t{backup.name}\t{recording.name}\n"
            beside[RECORDINGS] = (self._noted() + noted).encode(errors="surrogateescape")
        try:
            return replace_kept(self.file, calibration_json(self.motors).encode(), beside)
        except OSError as error:
            raise ConfigError(f"cannot be written: {error.strerror}", file=self.file) from error

    def _noted(self) -> str:
        """Return a line for each recording whose offsets are in the file: digest, name of the old file, recording."""
        target = link_target(self.file)
        try:
            noted = target.with_name(target.name + RECORDINGS).read_bytes()
        except OSError:
            return ""
        return noted.decode(errors="surrogateescape")


def _digest(recording: Path | None) -> str | None:
    """Return the SHA-256 of a recording in one file; None of any other."""
    if recording is None or not recording.is_file():
        return None
    digest = hashlib.sha256()
    recent = recording.with_name(f"{recording.name}-wal")  # where SQLite keeps what it has not yet put into a store
    try:
        for file in (recording, recent):
            if file is recording or file.is_file():
                with file.open("rb") as stream:
                    hashlib.file_digest(stream, lambda: digest)
    except OSError:
        return None
    return digest.hexdigest()


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
