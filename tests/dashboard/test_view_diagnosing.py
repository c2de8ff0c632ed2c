"""Diagnoses started from the page, as real processes."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from small_arm import write_small_arm

from bodyschema.daemon.config import Config
from bodyschema.dashboard.diagnosing import Diagnoses
from bodyschema.dashboard.documents import DiagnosisDocument
from bodyschema.interfaces.errors import BusError, RequestError
from bodyschema.interfaces.records import Pair, frozen_array

# only ends a diagnosis that would never end
LIMIT_S = 500.0
OVER = ("done", "failed", "stopped")


class Stored:
    """A sampler's history of stored pairs; it waits for `go` before its first page."""

    def __init__(self, config: Config, pairs: int) -> None:
        rng = np.random.default_rng(7)
        q = rng.uniform(-1.5, 1.5, (pairs, 2))
        x = config.robot.chain.with_tool([0.02, 0.01, 0.0]).positions(q) + rng.normal(0.0, 1e-4, (pairs, 3))
        cov = frozen_array(1e-8 * np.eye(3))
        self._left = [
            Pair("2f9a", k + 1, 1, 0.1 * k, "", frozen_array(q[k]), frozen_array(x[k]), cov) for k in range(pairs)
        ]
        self.go = threading.Event()

    def page(self) -> list[Pair]:
        self.go.wait(LIMIT_S)
        page, self._left = self._left[:100], self._left[100:]
        return page


class Said:
    """Recorder of the published states of diagnoses."""

    def __init__(self) -> None:
        self.states: list[str] = []
        self.newest = DiagnosisDocument()
        self.over = threading.Event()

    def __call__(self, document: DiagnosisDocument) -> None:
        self.newest = document
        self.states.append(document.state)
        if document.state in OVER:
            self.over.set()


@pytest.fixture
def config(tmp_path: Path) -> Config:
    return Config.load(write_small_arm(tmp_path), {})


@pytest.fixture
def said() -> Said:
    return Said()


@pytest.fixture
def diagnoses(config: Config, said: Said) -> Iterator[Callable[..., Diagnoses]]:
    opened: list[Diagnoses] = []

    def of(history) -> Diagnoses:
        opened.append(Diagnoses(config.file, config.robot.joints, lambda _newest: history(), said))
        return opened[-1]

    yield of
    for each in opened:
        each.__exit__(None, None, None)


def stored(config: Config, pairs: int) -> Stored:
    history = Stored(config, pairs)
    history.go.set()
    return history


def test_a_diagnosis_leaves_its_report(config, said, diagnoses) -> None:
    asked = diagnoses(lambda: stored(config, 60))
    assert asked.report() is None
    assert asked.start() == 1
    assert said.over.wait(LIMIT_S)
    assert (said.newest.state, said.newest.pairs, said.newest.report) == ("done", 60, 1), said.newest.said
    assert b"<!doctype html>" in asked.report()


@pytest.mark.soak
def test_missing_diagnosis_input_is_shown_on_page(config, said, diagnoses) -> None:
    diagnoses(lambda: stored(config, 3)).start()
    assert said.over.wait(LIMIT_S)
    assert said.newest.state == "failed"
    assert "3 samples are too few" in said.newest.said


def gone():
    raise BusError("the sampler does not answer")


def test_without_a_sampler_the_page_is_told_so(said, diagnoses) -> None:
    diagnoses(gone).start()
    assert said.over.wait(LIMIT_S)
    assert (said.newest.state, said.newest.said) == ("failed", "the sampler does not answer")


def test_single_diagnosis_runs_and_can_be_stopped(config, said, diagnoses) -> None:
    history = Stored(config, 150)
    asked = diagnoses(lambda: history)
    asked.start()
    with pytest.raises(RequestError, match="a diagnosis is running"):
        asked.start()
    asked.stop()
    history.go.set()
    assert said.over.wait(LIMIT_S)
    assert (said.newest.state, said.newest.report) == ("stopped", None)


def test_there_is_nothing_to_stop_before_one_runs(diagnoses) -> None:
    with pytest.raises(RequestError, match="no diagnosis"):
        diagnoses(None).stop()


def test_what_was_copied_is_gone_with_the_page(config, said, tmp_path, monkeypatch) -> None:
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(folder))
    with Diagnoses(config.file, config.robot.joints, lambda _newest: gone(), said) as asked:
        asked.start()
        assert list(folder.iterdir())
        assert said.over.wait(LIMIT_S)
    assert list(folder.iterdir()) == []
