"""Run a diagnosis for the commands: read the pairs, diagnose, write the files. `diagnosis_view.py` shows the result."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cached_property
from importlib.metadata import version
from pathlib import Path

import msgspec
import numpy as np

from bodyschema.calibration.plausibility.check import plausibility, recorded_sigma
from bodyschema.calibration.plausibility.limits import require_units
from bodyschema.cli.recordings.recorder import History
from bodyschema.daemon.config import Config
from bodyschema.daemon.transport.session import client
from bodyschema.diagnosis.assess.stored import predicted_pose_covariance
from bodyschema.diagnosis.diagnosis import Diagnosis
from bodyschema.diagnosis.diagnosis import diagnose as diagnosed
from bodyschema.diagnosis.fit.observations import encoder_steps
from bodyschema.diagnosis.report.conclusion import conclusion
from bodyschema.diagnosis.report.page import About, page
from bodyschema.diagnosis.report.result import DiagnosisFile
from bodyschema.diagnosis.report.text import modelled, remedies
from bodyschema.diagnosis.search.hypotheses import HypothesisSettings
from bodyschema.effects import EFFECT_TYPES, write_corrected, write_extended
from bodyschema.effects.effect_type import CameraEffect
from bodyschema.interfaces.errors import BodyschemaError, RecordingError, RequestError
from bodyschema.interfaces.records import FloatArray, Pair
from bodyschema.interfaces.whole_files import raising_write_errors, write_atomically
from bodyschema.learning.nominal import NominalModel
from bodyschema.recordings import files as recordings
from bodyschema.recordings.recording import Recording
from bodyschema.robot.calibrated_files import CAMERA_LINK
from bodyschema.robot.description import RobotDescription
from bodyschema.robot.hand_eye import HandEye, pose_covariance
from bodyschema.robot.suggest import did_you_mean

DIAGNOSIS, REPORT, POSE_COVARIANCE = "diagnosis.json", "report.html", "pose_covariance"
# Effects that are always looked for.
ALWAYS = ("outliers",)
Tell = Callable[[str], None]


class DiagnosisError(BodyschemaError):
    """There is nothing to diagnose, or it cannot be of this robot."""


@dataclass(frozen=True)
class DiagnosisSettings:
    """Settings of a diagnosis."""

    # only, without: names of effects; all when `only` is empty
    only: tuple[str, ...]
    without: tuple[str, ...]
    seed: int  # of the resampling

    @classmethod
    def of(cls, only: str | None, without: str | None, seed: int) -> DiagnosisSettings:
        """Parse comma-separated names; raise RequestError if an effect is unknown, or none remains."""
        settings = cls(_names(only, "--effects"), _names(without, "--exclude"), seed)
        if set(settings.only or EFFECT_TYPES) <= set(settings.without):
            raise RequestError("--effects and --exclude leave nothing to look for. Exclude fewer")
        return settings


def _names(text: str | None, option: str) -> tuple[str, ...]:
    if text is None:
        return ()
    names = tuple(name.strip() for name in text.split(",") if name.strip())
    if not names:
        raise RequestError(f"{option} names no effect. Known are: {', '.join(EFFECT_TYPES)}")
    for name in names:
        if name in ALWAYS:
            raise RequestError(f"{option} {name}: {name} are always looked for, and left out. Take it out")
        if name not in EFFECT_TYPES:
            raise RequestError(f"{option}: there is no effect {name!r}. {did_you_mean(name, EFFECT_TYPES)}")
    return names


@dataclass(frozen=True, eq=False)
class Source:
    """Recording and its name."""

    recording: Recording
    name: str


def measured(
    config: Config, file: Path | None, opened: Callable[[Path], Recording] | None = None, *, live: bool
) -> Source:
    """Return the pairs of a recording, of a store, or of the running sampler.

    Args:
        opened: function that reads `file`; by default as a recording or a store.

    Raises:
        RequestError: neither or both of `file` and `live` were given.
        BusError: no sampler is running.
        RecordingError: they cannot be read, or are not in radians and metres.
    """
    if live == (file is not None):
        raise RequestError("name a recording, or give --live for the running sampler's samples: one of the two")
    joints = config.robot.joints
    if file is None:
        with client(config.route("sampler")) as bus:
            recording, name = _history(History(bus, config.robot, 1), joints), f"the sampler of {config.robot.name}"
    else:
        recording, name = recordings.opened(file, joints) if opened is None else opened(file), file.name
    require_units(config.robot, recording, file or Path(name))
    return Source(recording, name)


def _history(history: History, joints: tuple[str, ...]) -> Recording:
    pairs: list[Pair] = []
    while page := history.page():
        pairs += page
    if not pairs:
        raise DiagnosisError("the sampler has no samples yet. Move the arm in front of the camera")
    return recordings.from_pairs(pairs, joints)


@dataclass(frozen=True, eq=False)
class ReportedDiagnosis:
    """Diagnosis with its context for the report."""

    diagnosis: Diagnosis
    source: Source
    robot: RobotDescription
    warnings: tuple[str, ...]  # possible faults of the recording itself

    @cached_property
    def file(self) -> DiagnosisFile:
        """The contents of diagnosis.json."""
        return conclusion(self.diagnosis)

    @property
    def json(self) -> str:
        """diagnosis.json, with the camera's pose in addition to the findings, and the covariance of predicted poses."""
        covariance = predicted_pose_covariance(self.diagnosis.stored)
        contents = msgspec.to_builtins(self.file, enc_hook=float) | {
            "hand_eye": msgspec.to_builtins(self.hand_eye),
            POSE_COVARIANCE: None if covariance is None else covariance.ravel().tolist(),
        }
        return msgspec.json.format(msgspec.json.encode(contents), indent=1).decode()

    @property
    def hand_eye(self) -> HandEye:
        """The camera's pose with the findings applied. Without a fitted pose it has no covariance."""
        fit, covariance = self.diagnosis.stored, None
        effects = fit.simulation.effects
        shifts = [effect for effect in effects if isinstance(effect.kind, CameraEffect) and effect.kind.rigid]
        ends = np.cumsum([len(effect.values) for effect in shifts])

        def pose(values: FloatArray) -> FloatArray:
            parts = zip(shifts, np.split(values, ends), strict=False)
            moved = fit.simulation.with_effects([effect.with_values(part) for effect, part in parts])
            return self.robot.camera.pose @ moved.camera_pose

        values = np.concatenate([np.empty(0), *(effect.values for effect in shifts)])
        if shifts:
            places = [place for effect in shifts for place in fit.places(effect)]
            covariance = pose_covariance(pose, values, fit.covariance[np.ix_(places, places)])
        return HandEye.of(self.robot.camera.parent_link, CAMERA_LINK, pose(values), covariance)

    @property
    def timed(self) -> bool:
        """True if the recording has times."""
        return self.source.recording.t is not None

    @property
    def remedies(self) -> list[str]:
        run = self.diagnosis.extended.run
        torques = np.abs(run.torques).max(axis=0)
        return remedies(self.file, self.robot, encoder_steps(self.source.recording.q), torques)


def run(
    config: Config, source: Source, settings: DiagnosisSettings, tell: Tell, *, force: bool = False
) -> ReportedDiagnosis:
    """Diagnose.

    Args:
        force: continue with pairs that do not seem to be of this robot.

    Raises:
        DiagnosisError: there are not enough data.
        RecordingError: the pairs cannot be of this robot in their present form.
    """
    robot, recording = config.robot, source.recording
    min_pairs = 5 * len(robot.joints)
    if len(recording) < min_pairs:
        raise DiagnosisError(
            f"{source.name}: {len(recording)} samples are too few to tell causes of {len(robot.joints)} joints apart. "
            f"Record at least {min_pairs}; some hundred are better"
        )
    if np.ptp(recording.q, axis=0).max() < HypothesisSettings.still:
        raise DiagnosisError(f"{source.name}: no joint ever moved. Guide each joint through its range")
    tell(f"{len(recording)} samples of {source.name}")
    chain = NominalModel.extended_by(config.simulation).chain
    plausible = plausibility(
        robot,
        recording.q,
        recording.x,
        t=recording.t,
        chain=chain,
        sigma_m=recorded_sigma(recording),
        orientation=recording.orientation,
    )
    warnings = plausible.require(source.name, force=force)
    diagnosis = diagnosed(
        recording, config.simulation, only=settings.only, without=settings.without, seed=settings.seed, tell=tell
    )
    if not diagnosis.hypotheses.effects:
        raise DiagnosisError(
            f"{source.name}: nothing to look for. {' '.join(diagnosis.hypotheses.limitations)}".strip()
        )
    return ReportedDiagnosis(diagnosis, source, robot, warnings)


@contextmanager
def results_in(folder: Path | None) -> Iterator[None]:
    """Create the folder for results before minutes of work are lost, and remove it after an end without a result.

    Raises:
        RecordingError: nothing can be written to it.
    """
    if folder is None:
        yield
        return
    new = [place for place in (folder, *folder.parents) if not place.exists()]
    require_writable(folder)
    try:
        yield
    except BaseException:
        for place in new:
            with suppress(OSError):  # another program has put something there meanwhile
                place.rmdir()
        raise


def require_writable(folder: Path) -> None:
    """Create the folder; raise RecordingError if nothing can be written to it."""
    with raising_write_errors(folder, RecordingError, remedy="Give another folder"):
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass


def written(found: ReportedDiagnosis, folder: Path) -> None:
    """Write the files of DIR; raise ConfigError, RecordingError if they cannot be written."""
    about = About(found.source.name, found.robot.name, version("bodyschema"))
    heading = f"Found by bodyschema {about.version} in {len(found.source.recording)} samples of {about.recording}"
    extended = found.diagnosis.stored.written
    description = " ".join(filter(None, [f"{heading}.", modelled(found.file.unexplained)]))
    write_extended(extended, folder, description, replace=True)
    # Tolerances alone are put into a URDF only if the recording determines them.
    with_tolerances = (
        extended if found.diagnosis.estimated_tolerances.is_detected[:2].any() else extended.with_background(())
    )
    write_corrected(with_tolerances, folder, heading)
    with raising_write_errors(folder, RecordingError):
        folder.mkdir(parents=True, exist_ok=True)
        report = page(found.diagnosis, found.file, found.remedies, about)
        write_atomically({folder / DIAGNOSIS: f"{found.json}\n".encode(), folder / REPORT: report.encode()})
