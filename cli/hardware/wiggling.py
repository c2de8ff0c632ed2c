"""Record encoders and marker, unpaired, while the arm is moved; read and write such recordings."""

from __future__ import annotations

import csv
import io
import threading
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bodyschema.calibration.latency import LatencyError, LatencySettings, Wiggle
from bodyschema.daemon.sampler.sources import Sources
from bodyschema.interfaces.clock import SystemClock
from bodyschema.interfaces.errors import RecordingError, SourceEnded, SourceLost
from bodyschema.interfaces.records import JointReading, MarkerFix, MarkerMiss
from bodyschema.interfaces.waits import Waits
from bodyschema.interfaces.whole_files import raising_write_errors, write_atomically
from bodyschema.robot.limited import read_at_most

LIMIT_S = 30.0  # without a fix
POSITION = ("x", "y", "z")


@dataclass(frozen=True, slots=True)
class Collected:
    """Data recorded from the sources."""

    wiggle: Wiggle
    missed: Counter[str]  # number of images without a fix, by reason
    health: tuple[str, ...] = ()  # faults of the cameras with their remedies

    @property
    def summary(self) -> str:
        """Message on missed images if at least one in five gave no fix, otherwise empty."""
        fixes, missed = len(self.wiggle.t_marker), self.missed.total()
        if missed < 0.2 * (fixes + missed):
            return ""
        return f"the marker was found in {fixes} of {fixes + missed} images: {_reasons(self.missed)}"


def _reasons(missed: Counter[str]) -> str:
    return ", ".join(f"{count} {reason.replace('_', ' ')}" for reason, count in missed.most_common())


def collected(sources: Sources, duration_s: float, tell: Callable[[float], None]) -> Collected:
    """Record the sources for `duration_s` [s] of their clock, and a little longer for the largest latency.

    Args:
        tell: called with the time [s] since the first fix.

    Raises:
        LatencyError: the sources deliver nothing, the encoders are lost, or the marker is not found.
        SourceError: they cannot be opened, or the cameras are lost.
    """
    readings: list[JointReading] = []
    fixes: list[MarkerFix] = []
    failures: list[Exception] = []
    missed: Counter[str] = Counter()
    health: tuple[str, ...] = ()
    ending = threading.Event()

    def read_joints() -> None:
        try:
            while not ending.is_set():
                reading = sources.joints.read(Waits.read_s)
                if reading is not None and np.isfinite(reading.q).all():
                    readings.append(reading)
        except SourceEnded:
            return
        except Exception as error:
            failures.append(error)

    clock, last = SystemClock(), duration_s + LatencySettings.latest_s
    with sources.joints, sources.marker:
        thread = threading.Thread(target=read_joints, name="encoders")
        thread.start()
        try:
            until = clock.now() + LIMIT_S
            while clock.now() < until and not failures:
                try:
                    seen = sources.marker.read(Waits.read_s)
                except SourceEnded:
                    break
                if isinstance(seen, MarkerMiss):
                    missed[seen.reason] += 1
                elif seen is not None:
                    until = clock.now() + LIMIT_S
                    fixes.append(seen)
                    tell(seen.t - fixes[0].t)
                    if seen.t - fixes[0].t >= last:
                        break
        finally:
            ending.set()
            thread.join()
        if sources.cameras is not None:
            health = tuple(sources.cameras.health)
    if failures:
        if isinstance(failures[0], SourceLost):
            raise LatencyError(
                f"the encoders were lost while the arm was moved ({failures[0].brief}). Try again; if it comes again, "
                "`bodyschema doctor`"
            ) from failures[0]
        raise failures[0]
    if missed and not fixes:
        raise LatencyError(
            f"the marker was found in none of {missed.total()} images: {_reasons(missed)}. "
            "`bodyschema watch cameras` shows what they see"
        )
    return Collected(wiggle_of(readings, fixes), missed, health)


def wiggle_of(readings: Sequence[JointReading], fixes: Sequence[MarkerFix]) -> Wiggle:
    """Return readings and fixes as arrays; raise LatencyError if either is missing."""
    if not readings or not fixes:
        who = "the encoders" if not readings else "the cameras"
        raise LatencyError(f"{who} gave nothing: `bodyschema doctor`, and for the marker `bodyschema watch cameras`")
    return Wiggle(
        np.array([reading.t for reading in readings]),
        np.array([reading.q for reading in readings]),
        np.array([fix.t for fix in fixes]),
        np.array([fix.x for fix in fixes]),
    )


def write_wiggle(wiggle: Wiggle, joints: Sequence[str], file: Path) -> None:
    """Write one row for each reading and each fix, ordered by time; the columns of the other kind stay empty.

    Raises:
        RecordingError: it cannot be written.
    """
    rows: list[tuple[float, list[str]]] = []
    blank_joints, blank_position = [""] * len(joints), [""] * len(POSITION)
    for t, q in zip(wiggle.t_joints.tolist(), wiggle.q.tolist(), strict=True):
        rows.append((t, [repr(t), *map(repr, q), *blank_position]))
    for t, x in zip(wiggle.t_marker.tolist(), wiggle.x.tolist(), strict=True):
        rows.append((t, [repr(t), *blank_joints, *map(repr, x)]))
    text = io.StringIO(newline="")
    writer = csv.writer(text)
    writer.writerow(["t", *joints, *POSITION])
    writer.writerows(row for _, row in sorted(rows, key=lambda each: each[0]))
    with raising_write_errors(file, RecordingError):
        write_atomically({file: text.getvalue().encode()})


def read_wiggle(file: Path, joints: Sequence[str]) -> Wiggle:
    """Read a file written by `write_wiggle`.

    Raises:
        RecordingError: it cannot be read, has other columns, or has a row that is neither reading nor fix.
    """
    columns = ["t", *joints, *POSITION]
    readings: list[list[float]] = []
    fixes: list[list[float]] = []
    try:
        with io.StringIO(read_at_most(file).decode(), newline="") as stream:
            rows = csv.reader(stream)
            if next(rows, []) != columns:
                remedy = "Record one with `bodyschema calibrate latency --save`"
                raise RecordingError(f"the columns are not {', '.join(columns)}", file=file, line=1, remedy=remedy)
            for number, row in enumerate(rows, 2):
                angles, position = row[1 : -len(POSITION)], row[-len(POSITION) :]
                if len(row) != len(columns) or any(angles) == any(position):
                    raise RecordingError("has to have joint angles or a position", file=file, line=number)
                cells = [row[0], *(angles if any(angles) else position)]
                try:
                    (readings if any(angles) else fixes).append([float(cell) for cell in cells])
                except ValueError as error:
                    raise RecordingError(f"{error}", file=file, line=number) from error
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise RecordingError(f"cannot be read: {error}", file=file) from error
    if not readings or not fixes:
        raise RecordingError("has to have rows with joint angles and rows with a position", file=file)
    q, x = np.array(readings), np.array(fixes)
    return Wiggle(q[:, 0], q[:, 1:], x[:, 0], x[:, 1:])
