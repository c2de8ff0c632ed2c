"""Export a robot with its effects to files of other programs, and measure the improvement on recorded data."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np
from msgspec import Meta

from bodyschema.cli.hardware.driver_snippets import IN_DRIVERS, write_snippets
from bodyschema.cli.terminal.diagnosis_run import DIAGNOSIS
from bodyschema.diagnosis.fit.alignment import aligned
from bodyschema.diagnosis.fit.observations import Observations
from bodyschema.effects import Motion, Simulation
from bodyschema.effects.exports import corrected, replayed, write_correction, write_mjcf, write_urdf
from bodyschema.effects.exports.replay import mujoco_version
from bodyschema.effects.files import EXTENDED_FILE
from bodyschema.interfaces.errors import ConfigError
from bodyschema.interfaces.records import FloatArray
from bodyschema.recordings.recording import Recording
from bodyschema.robot.limited import read_at_most

MJCF, URDF, CORRECTION, DRIVERS = ".xml", ".urdf", ".json", ".txt"


def _write_correction(simulation: Simulation, file: Path, heading: str) -> list[str]:
    """Write correction.json with the covariance of poses from the diagnosis.json beside extended.toml, if it is one."""
    found, known = simulation.robot.file.with_name(DIAGNOSIS), None
    if simulation.robot.file.name == EXTENDED_FILE and found.is_file():
        try:
            known = msgspec.json.decode(read_at_most(found), type=_Known).pose_covariance
        except (OSError, msgspec.DecodeError) as error:
            raise ConfigError(f"is not what diagnose wrote: {error}", file=found, remedy="Diagnose again") from error
    told = write_correction(simulation, file, heading, known)
    if known is None:
        told.append(
            f"not in it: the pose's covariance, which {DIAGNOSIS} beside {EXTENDED_FILE} has if anything was fitted"
        )
    return told


class _Known(msgspec.Struct, frozen=True):
    """What a correction takes of diagnosis.json."""

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
    if out.suffix.lower() not in _WRITERS:
        raise ConfigError(f"a robot's files end in {', '.join(_WRITERS)}", file=out, remedy="Give another name")
    if not out.parent.is_dir():
        raise ConfigError(f"there is no folder {out.parent}", file=out, remedy="Make it first")
    if out.exists() and not force:
        raise ConfigError("the file is there already", file=out, remedy="Give another name, or --force")


def write(simulation: Simulation, out: Path) -> list[str]:
    """Write the simulation in the format of the ending of `out`. The file appears once it is complete.

    Returns:
        Sentences on what the file does not represent, or represents differently.

    Raises:
        ConfigError: the file cannot be written.
    """
    part = out.with_name(f".{out.stem}.part{out.suffix}")
    heading = f"{simulation.robot.name}, by bodyschema {version('bodyschema')} from {simulation.robot.file.name}"
    try:
        told = _WRITERS[out.suffix.lower()](simulation, part, heading)
        os.replace(part, out)
    except OSError as error:
        raise ConfigError(f"cannot be written: {error.strerror or error}", file=out) from error
    finally:
        part.unlink(missing_ok=True)
    return told


def effects_of(simulation: Simulation) -> str:
    """Return how many effects a simulation has; those within tolerance of all links and drives are counted apart."""
    count, small = len(simulation.effects), len(simulation.background)
    told = "without effects" if not count else f"with {count} effect{'s' if count > 1 else ''}"
    return f"{told} and {small} small error{'s' if small > 1 else ''} within tolerance" if small else told


@dataclass(frozen=True)
class Row:
    """Errors of one model on measured positions.

    Attributes:
        model: its name.
        rms_mm, mean_mm: RMS and mean of the distances to the measured positions.
        gain_percent: reduction of the RMS relative to the nominal model; None for that one.
    """

    model: str
    rms_mm: float
    mean_mm: float
    gain_percent: float | None


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
        kept = tuple(effect for effect in simulation.after_moments.all_effects if effect.name in IN_DRIVERS)
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
    from bodyschema.robot.calibrated_files import CAMERA_LINK, MARKER_LINK
    from bodyschema.robot.urdf import UrdfTree, chain_between

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
