"""Diagnoses requested on the page: each runs in a separate process, on pairs copied from the sampler."""

from __future__ import annotations

import logging
import os
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Self

import msgspec

from bodyschema.cli.recordings.diagnosis import DIAGNOSIS, REPORT
from bodyschema.cli.recordings.recorder import History
from bodyschema.daemon.service.signals import with_parent
from bodyschema.diagnosis.report.result import DiagnosisFile
from bodyschema.interfaces.errors import BodyschemaError, RecordingError, RequestError
from bodyschema.interfaces.interpreter import module_command
from bodyschema.interfaces.records import Pair
from bodyschema.interfaces.waits import NICENESS
from bodyschema.recordings import files as recordings

from .documents import DiagnosisDocument

log = logging.getLogger(__name__)

# More pairs would take many minutes, and hardly change the result.
NEWEST_PAIRS = 4000
RECORDING = "newest_pairs.csv"


class Diagnoses:
    """Runner of one diagnosis after the other within a with statement."""

    def __init__(
        self,
        robot_file: Path,
        joints: tuple[str, ...],
        history: Callable[[int], History],
        on_change: Callable[[DiagnosisDocument], None],
    ) -> None:
        self._robot_file, self._joints, self._history, self._on_change = robot_file, joints, history, on_change
        self._lock = threading.Lock()
        self._document = DiagnosisDocument()
        self._thread: threading.Thread | None = None
        self._child: subprocess.Popen[str] | None = None
        self._stopping = False
        self._folder = tempfile.TemporaryDirectory(prefix="bodyschema-view-")
        on_change(self._document)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._end()
        if self._thread is not None:
            self._thread.join()
        self._folder.cleanup()

    def start(self) -> int:
        """Start a diagnosis and return its number; raise RequestError if one is running."""
        with self._lock:
            if self._thread is not None and self._thread.is_alive():
                raise RequestError("a diagnosis is running. Wait for it, or stop it")
            number = self._document.number + 1
            self._stopping = False
            self._thread = threading.Thread(target=self._run, args=(number,), name="diagnosis")
            self._publish(number=number, state="copying", pairs=0, said="", started=time.time(), verdict=None)
            self._thread.start()
        return number

    def stop(self) -> None:
        """End the running diagnosis; raise RequestError if none is running."""
        if self._thread is None or not self._thread.is_alive():
            raise RequestError("no diagnosis is running")
        self._end()

    def report(self) -> bytes | None:
        """Return the page of the last diagnosis, or None."""
        number = self._document.report
        return None if number is None else (self._output(number) / REPORT).read_bytes()

    def _output(self, number: int) -> Path:
        return Path(self._folder.name) / str(number)

    def _end(self) -> None:
        with self._lock:
            self._stopping = True
            if self._child is not None:
                self._child.terminate()

    def _run(self, number: int) -> None:
        try:
            pairs = self._copy(self._output(number))
            self._publish(state="running", pairs=pairs, said="starting")
            self._diagnose(self._output(number), number)
        except Exception as error:
            if not isinstance(error, BodyschemaError):
                log.exception("a diagnosis failed")
            self._publish(state="stopped" if self._stopping else "failed", said="" if self._stopping else str(error))

    def _copy(self, out: Path) -> int:
        out.mkdir()
        history = self._history(NEWEST_PAIRS)
        pairs: list[Pair] = []
        while not self._stopping and len(pairs) < NEWEST_PAIRS and (page := history.page()):
            pairs += page
        if not pairs or self._stopping:
            raise RequestError("the sampler has no samples yet. Move the arm in front of the camera")
        recordings.write(recordings.from_pairs(pairs, self._joints), out / RECORDING)
        return len(pairs)

    def _diagnose(self, out: Path, number: int) -> None:
        command = module_command(
            "bodyschema", "diagnose", str(out / RECORDING), "--robot", str(self._robot_file), "--out", str(out)
        )
        with self._lock:
            if self._stopping:
                raise RequestError("stopped")
            # This thread waits for the child, which must not outlive it.
            self._child = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
                text=True,
                env=os.environ | with_parent(),
                process_group=0,
            )
        os.setpriority(os.PRIO_PROCESS, self._child.pid, NICENESS)
        last = self._follow(self._child)
        code = self._child.wait()
        with self._lock:
            self._child = None
        if code != 0:
            raise RecordingError(last.removeprefix("bodyschema: ") or f"ended with code {code}", file=RECORDING)
        file = msgspec.json.decode((out / DIAGNOSIS).read_bytes(), type=DiagnosisFile)
        self._publish(state="done", said=file.sentence, verdict=file.verdict, report=number)

    def _follow(self, child: subprocess.Popen[str]) -> str:
        """Report each step; return the last line of the child's output."""
        last = ""
        assert child.stderr is not None
        with child.stderr:
            for line in child.stderr:
                if line.strip():
                    last = line.strip()
                    self._publish(said=last)
        return last

    def _publish(self, **changed: object) -> None:
        self._document = msgspec.structs.replace(self._document, **changed)
        self._on_change(self._document)
