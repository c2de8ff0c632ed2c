"""Diagnosis of many recordings on Dask: on this machine's cores, or on the workers of a scheduler.

This process reads the recording and the robot's description and sends both to a worker. A worker needs bodyschema
installed, but no access to these files.
"""

from __future__ import annotations

import logging
import os
import signal
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from bodyschema.cli.commands.options import robot_file
from bodyschema.cli.recordings.diagnosis import (
    DiagnosisSettings,
    ReportedDiagnosis,
    Source,
    measured,
    require_writable,
    run,
    written,
)
from bodyschema.daemon.config import Config
from bodyschema.diagnosis.report.result import DiagnosisFile
from bodyschema.interfaces.errors import BodyschemaError, ConfigError, RecordingError, RequestError
from bodyschema.interfaces.interpreter import safe_children
from bodyschema.recordings.files import STORE_ENDINGS
from bodyschema.recordings.recording import CSV, PARQUET

ENDINGS = (CSV, PARQUET, *STORE_ENDINGS)


@dataclass(frozen=True)
class Job:
    name: str  # unique name of the row and of the report's folder
    recording: Path  # its file
    robot: Path  # its robot.toml


def jobs(recordings: Sequence[Path], folder: Path | None, robot: Path | None) -> list[Job]:
    """Return the given recordings and those in a folder, each with `robot` or the robot.toml next to it.

    A recording has the name of its file; if two files have the same name, that of the folder and the file.

    Raises:
        RequestError: no recording was given.
        RecordingError: the folder does not exist, or has none.
    """
    found = [*recordings, *([] if folder is None else _in(folder))]
    files = list(dict.fromkeys(found))
    if not files:
        raise RequestError(
            f"there is nothing to diagnose. Name recordings ({', '.join(ENDINGS)}), or a folder by --from"
        )
    stems = Counter(file.stem for file in files)
    names = [file.stem if stems[file.stem] == 1 else f"{file.absolute().parent.name}_{file.stem}" for file in files]
    alike = Counter(names)
    numbered = [name if alike[name] == 1 else f"{name}_{k}" for k, name in enumerate(names, 1)]
    return [Job(name, file, robot_file(robot, file)) for name, file in zip(numbered, files, strict=True)]


def _in(folder: Path) -> list[Path]:
    if not folder.is_dir():
        raise RecordingError("there is no such folder", file=folder, remedy="Give the folder with the recordings")
    found = sorted(file for file in folder.rglob("*") if file.suffix.lower() in ENDINGS and file.is_file())
    if not found:
        raise RecordingError(f"no recording is in it ({', '.join(ENDINGS)})", file=folder, remedy="Give another --from")
    return found


if TYPE_CHECKING:
    from distributed import Client, Future


class _Settings:
    # A diagnosis that ended this many workers (by running out of memory, for example) is not tried again.
    workers_lost: int = 1
    connect_limit_s: float = 10.0  # to a scheduler of Dask


TOPIC = "bodyschema"


@dataclass(frozen=True)
class Diagnosed:
    """Result for one recording."""

    job: Job  # the recording
    robot: str  # name of its robot
    joints: tuple[str, ...]  # of its robot; empty if its description could not be read
    file: DiagnosisFile | None = None  # the diagnosis, or None
    timed: bool = False  # True if the recording has times
    error: str | None = None  # the reason why there is none


@dataclass(frozen=True)
class _Read:
    """Recording that can be diagnosed."""

    job: Job
    config: Config
    source: Source


ReportProgress = Callable[[str, str], None]
ReportResult = Callable[[Diagnosed], None]


def diagnose_all(
    jobs: Sequence[Job],
    settings: DiagnosisSettings,
    out: Path | None,
    cluster: Client,
    report_progress: ReportProgress,
    done: ReportResult,
) -> list[Diagnosed]:
    """Diagnose all recordings; a failed one is reported as such, and does not end the others.

    Args:
        out: folder in which a folder for each recording is written.
        cluster: a client of the scheduler; running work is cancelled if this ends early.
        report_progress: called with a recording's name and its current step.

    Returns:
        The results, in the order of the jobs.

    Raises:
        RecordingError: the folder cannot be written.
    """
    from distributed import as_completed

    if out is not None:
        require_writable(out)
    results: dict[str, Diagnosed] = {}

    def take(result: Diagnosed) -> None:
        results[result.job.name] = result
        done(result)

    futures: dict[Future[Any], _Read] = {}
    cluster.subscribe_topic(TOPIC, lambda event: report_progress(*event[1]))
    try:
        for read in map(_read, jobs):
            if isinstance(read, Diagnosed):
                take(read)
                continue
            work = cluster.submit(_work, read, settings, out is not None, key=f"diagnose-{read.job.name}", pure=False)
            futures[work] = read
        for future in as_completed(list(futures), raise_errors=False):
            take(_result(future, futures[future], out))
    finally:
        cluster.cancel(list(futures), force=True)
        cluster.unsubscribe_topic(TOPIC)
    return [results[job.name] for job in jobs]


@contextmanager
def workers(scheduler: str | None, jobs: int, count: int | None = None) -> Iterator[Client]:
    """Yield a client of the scheduler at an address; without one, of processes on this machine.

    Dask gives each process one thread of BLAS.

    Args:
        scheduler: its address; None starts processes here.
        count: number of processes; None for one per core, at most the number of jobs.

    Raises:
        ConfigError: the scheduler does not answer, or has no workers.
    """
    from dask import config
    from distributed import Client, LocalCluster

    logging.getLogger("distributed").setLevel(logging.CRITICAL)  # the diagnoses report the errors that matter
    with safe_children(), config.set({"distributed.scheduler.allowed-failures": _Settings.workers_lost}):
        if scheduler is not None:
            with _client_of(scheduler) as client:
                yield client
            return
        with (
            LocalCluster(
                n_workers=count or min(os.cpu_count() or 1, jobs),
                threads_per_worker=1,
                processes=True,
                dashboard_address="127.0.0.1:0",  # without a port it takes 8787, and warns if that is in use
                silence_logs=logging.CRITICAL,
            ) as local,
            Client(local) as client,
        ):
            client.run(_leave_ctrl_c)
            yield client


def _client_of(scheduler: str) -> Client:
    from distributed import Client

    try:
        client = Client(scheduler, timeout=_Settings.connect_limit_s)
    except (OSError, ValueError, TimeoutError) as error:
        raise ConfigError(
            f"no Dask scheduler answers on {scheduler}",
            remedy="Start one with `dask scheduler`, or leave --scheduler out: then this machine's cores do it",
        ) from error
    if not client.scheduler_info(n_workers=-1)["workers"]:
        client.close()
        raise ConfigError(
            f"the Dask scheduler on {scheduler} has no workers", remedy=f"Start some: `dask worker {scheduler}`"
        )
    return client


def _leave_ctrl_c() -> None:
    """Ignore Ctrl-C on a worker of our terminal: the parent process handles it and ends the worker."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _read(job: Job) -> _Read | Diagnosed:
    """Return the recording with its robot, or the reason why it cannot be read."""
    try:
        config = Config.load(job.robot)
    except BodyschemaError as error:
        return Diagnosed(job, job.name, (), error=str(error))
    try:
        return _Read(job, config, measured(config, job.recording, live=False))
    except BodyschemaError as error:
        return Diagnosed(job, config.robot.name, config.robot.joints, error=str(error))


def _work(read: _Read, settings: DiagnosisSettings, with_report: bool) -> tuple[bytes, ReportedDiagnosis | None] | str:
    """Diagnose on a worker: return diagnosis.json, and the input of the other files if they are written.

    Returns the reason as text if there is none, since not every exception of ours can be unpickled.
    """
    from distributed import get_worker

    worker = get_worker()
    try:
        found = run(read.config, read.source, settings, lambda said: worker.log_event(TOPIC, (read.job.name, said)))
    except BodyschemaError as error:
        return str(error)
    return found.json.encode(), found if with_report else None


def _result(future: Future[Any], read: _Read, out: Path | None) -> Diagnosed:
    robot = read.config.robot
    try:
        answer = future.result()
        if not isinstance(answer, str) and out is not None:
            written(answer[1], out / read.job.name)
    except Exception as error:  # a worker's error is reported in its row and does not concern the others
        answer = _why(error)
    if isinstance(answer, str):
        return Diagnosed(read.job, robot.name, robot.joints, error=answer)
    file = msgspec.json.decode(answer[0], type=DiagnosisFile)
    return Diagnosed(read.job, robot.name, robot.joints, file, read.source.recording.t is not None)


def _why(error: Exception) -> str:
    from distributed import KilledWorker

    if isinstance(error, BodyschemaError):
        return str(error)
    if isinstance(error, KilledWorker):
        return "its worker was ended, by the system for its memory perhaps. Try fewer --workers"
    if isinstance(error, ModuleNotFoundError):
        return f"the worker has no module {error.name}: install the same bodyschema there"
    return f"internal error, please report it: {type(error).__name__}: {error}"
