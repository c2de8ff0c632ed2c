"""One diagnosis from the command line: where the pairs come from, what is asked, what is written."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from importlib.metadata import version
from pathlib import Path

import msgspec
import numpy as np

from diagnosis.conclusion import conclusion
from diagnosis.diagnosis import Diagnosis
from diagnosis.diagnosis import diagnose as diagnosed
from diagnosis.hypotheses import STILL
from diagnosis.observations import ticks
from diagnosis.remedies import remedies
from diagnosis.report import About, page
from diagnosis.result import DiagnosisFile
from diagnosis.words import modelled
from effects import KINDS, write_corrected, write_extended
from interfaces.errors import BodyschemaError, RecordingError, RequestError
from interfaces.recording import Recording
from interfaces.records import FloatArray, Pair
from interfaces.robot import RobotDescription
from interfaces.suggest import did_you_mean
from kbmaps import KBMapsError, align

from . import recordings
from .bus import client
from .config import Config
from .plausibility import is_far_off, mixed_up, require_units
from .recorder import History

DIAGNOSIS, REPORT = "diagnosis.json", "report.html"
# Effects that are always looked for.
ALWAYS = ("outliers",)
# So many pairs for each joint are the fewest that say anything.
FEWEST_PAIRS_A_JOINT = 5
# Of the arm's reach, so much left by the drawn arm in its best place makes other orders of the columns worth a try.
SUSPECT = 0.005
# What may be wrong where nothing is found that is.
ELSE = "Are the columns in another order, does a joint count the other way, is a zero off by a quarter turn?"

Tell = Callable[[str], None]


class DiagnosisError(BodyschemaError):
    """There is nothing to diagnose, or it cannot be of this robot."""


@dataclass(frozen=True)
class Asked:
    """What to look for.

    Attributes:
        only, without: names of effects; all when `only` is empty.
        seed: of the resampling.
    """

    only: tuple[str, ...]
    without: tuple[str, ...]
    seed: int

    @classmethod
    def of(cls, only: str | None, without: str | None, seed: int) -> Asked:
        """From names with commas between; RequestError where there is no such effect, or none is left."""
        asked = cls(_names(only, "--effects"), _names(without, "--exclude"), seed)
        if set(asked.only or KINDS) <= set(asked.without):
            raise RequestError("--effects and --exclude leave nothing to look for. Exclude fewer")
        return asked


def _names(text: str | None, option: str) -> tuple[str, ...]:
    if text is None:
        return ()
    names = tuple(name.strip() for name in text.split(",") if name.strip())
    if not names:
        raise RequestError(f"{option} names no effect. Known are: {', '.join(KINDS)}")
    for name in names:
        if name in ALWAYS:
            raise RequestError(f"{option} {name}: {name} are always looked for, and left out. Take it out")
        if name not in KINDS:
            raise RequestError(f"{option}: there is no effect {name!r}. {did_you_mean(name, KINDS)}")
    return names


@dataclass(frozen=True, eq=False)
class Source:
    """What was measured, and what it is called."""

    recording: Recording
    name: str


def measured(config: Config, file: Path | None, *, live: bool) -> Source:
    """The pairs of a recording, of a store, or of the running sampler.

    Raises:
        RequestError: neither or both were asked for.
        BusError: no sampler is running.
        RecordingError: they cannot be read, or are not in radians and metres.
    """
    if live == (file is not None):
        raise RequestError("name a recording, or give --live for the running sampler's pairs: one of the two")
    joints = config.robot.joints
    if file is None:
        with client(config.route("sampler")) as bus:
            recording, name = _history(History(bus, config.robot, 1), joints), f"the sampler of {config.robot.name}"
    else:
        recording, name = recordings.opened(file, joints), file.name
    require_units(config.robot, recording, file or Path(name))
    return Source(recording, name)


def _history(history: History, joints: tuple[str, ...]) -> Recording:
    pairs: list[Pair] = []
    while page := history.page():
        pairs += page
    if not pairs:
        raise DiagnosisError("the sampler has no pairs yet. Move the arm in front of the camera")
    return recordings.from_pairs(pairs, joints)


@dataclass(frozen=True, eq=False)
class Found:
    """A diagnosis and what is told of it."""

    diagnosis: Diagnosis
    source: Source
    robot: RobotDescription

    @cached_property
    def file(self) -> DiagnosisFile:
        """The contents of diagnosis.json."""
        return conclusion(self.diagnosis)

    @property
    def json(self) -> str:
        """diagnosis.json."""
        return msgspec.json.format(msgspec.json.encode(self.file, enc_hook=float), indent=1).decode()

    @property
    def timed(self) -> bool:
        """Whether the recording has times."""
        return self.source.recording.t is not None

    @property
    def remedies(self) -> list[str]:
        """What to do about the causes."""
        run = self.diagnosis.extended.run
        torques = np.abs(run.torques).max(axis=0) if run.simulation.gravity.known else None
        return remedies(self.file, self.robot, ticks(self.source.recording.q), torques)


def run(config: Config, source: Source, asked: Asked, tell: Tell) -> Found:
    """Diagnose.

    Raises:
        DiagnosisError: there is too little to go by, or the pairs cannot be of this robot.
    """
    robot, recording = config.robot, source.recording
    fewest = FEWEST_PAIRS_A_JOINT * len(robot.joints)
    if len(recording) < fewest:
        raise DiagnosisError(
            f"{source.name}: {len(recording)} pairs are too few to tell causes of {len(robot.joints)} joints apart. "
            f"Record at least {fewest}; some hundred are better"
        )
    if np.ptp(recording.q, axis=0).max() < STILL:
        raise DiagnosisError(f"{source.name}: no joint ever moved. Guide each joint through its range")
    tell(f"{len(recording)} pairs of {source.name}")
    _require_columns(robot, recording, source.name)
    diagnosis = diagnosed(
        recording, config.simulation, only=asked.only, without=asked.without, seed=asked.seed, tell=tell
    )
    if not diagnosis.hypotheses.effects:
        raise DiagnosisError(
            f"{source.name}: nothing to look for. {' '.join(diagnosis.hypotheses.limitations)}".strip()
        )
    _require_this_robot(robot, recording, diagnosis.extended.run.measured, source.name)
    return Found(diagnosis, source, robot)


def _require_columns(robot: RobotDescription, recording: Recording, name: str) -> None:
    """DiagnosisError where the joints' columns are mixed up, or count the other way.

    Couplings and scales would fit that as well, as causes that are none.
    """
    known = {"pose_known": robot.camera.pose_known, "marker_known": robot.robot.marker_known}
    try:
        drawn = align(robot.chain, recording.q, recording.x, **known).chain.positions(recording.q)
    except KBMapsError as error:
        raise DiagnosisError(f"{name}: the simulation cannot be laid on the pairs: {error}") from error
    if not is_far_off(robot, np.linalg.norm(drawn - recording.x, axis=1), _told_sigma(recording), SUSPECT):
        return
    if (changed := mixed_up(robot, recording, _told_sigma(recording))) is not None:
        raise DiagnosisError(f"{name}: the columns of the joints seem to be mixed up. {changed}. Mend that first")


def _asked(robot: RobotDescription, recording: Recording) -> str:
    changed = mixed_up(robot, recording, _told_sigma(recording))
    return ELSE if changed is None else f"{changed}."


def _told_sigma(recording: Recording) -> float | None:
    """1-sigma of a coordinate [m], where the recording tells it."""
    if recording.cov is None:
        return None
    return float(np.sqrt(np.trace(recording.cov, axis1=1, axis2=2).mean() / 3.0))


def _require_this_robot(robot: RobotDescription, recording: Recording, predicted: FloatArray, name: str) -> None:
    """DiagnosisError where the extended simulation is so far off that the pairs are hardly of this robot."""
    left = np.linalg.norm(predicted - recording.x, axis=1)
    if is_far_off(robot, left, _told_sigma(recording)):
        raise DiagnosisError(
            f"{name}: whatever is tried, half of the pairs are missed by over {1e3 * float(np.median(left)):.3g} mm: "
            f"they are hardly of this robot. {_asked(robot, recording)}"
        )


def require_folder(folder: Path) -> None:
    """Make DIR, before minutes of work are lost; RecordingError where nothing can be written to it."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        told = f"cannot be written: {error.strerror or error}"
        raise RecordingError(told, file=folder, remedy="Give another folder") from error


def written(found: Found, folder: Path) -> None:
    """Write the files of DIR.

    Raises:
        ConfigError, RecordingError: they cannot be written.
    """
    about = About(found.source.name, found.robot.name, version("bodyschema"))
    heading = f"Found by bodyschema {about.version} in {len(found.source.recording)} pairs of {about.recording}"
    extended = found.diagnosis.extended.simulation
    told = " ".join(filter(None, [f"{heading}.", modelled(found.file.unexplained)]))
    write_extended(extended, folder, told, replace=True)
    write_corrected(extended, folder, heading)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / DIAGNOSIS).write_text(found.json + "\n", encoding="utf-8")
        (folder / REPORT).write_text(page(found.diagnosis, found.file, found.remedies, about), encoding="utf-8")
    except OSError as error:
        raise RecordingError(f"cannot be written: {error.strerror or error}", file=folder) from error
