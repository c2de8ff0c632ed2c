"""Recordings for the Rerun viewer, read back by its own tool."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from small_arm import JOINTS

from bodyschema.interfaces.errors import RecordingError
from bodyschema.recordings import files as recordings
from bodyschema.recordings.recording import Recording
from bodyschema.recordings.rerun_export import runs


@pytest.fixture
def recording() -> Recording:
    rng = np.random.default_rng(4)
    t = np.arange(6) / 10
    return Recording(
        JOINTS, rng.normal(size=(6, 2)), rng.normal(size=(6, 3)), t=t, segment=np.array([1, 1, 1, 2, 2, 3])
    )


def tool(*words: str) -> str:
    command = [sys.executable, "-m", "rerun_cli", "rrd", *words]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout


def test_rerun_s_own_tool_finds_every_row_in_the_file(tmp_path: Path, recording: Recording) -> None:
    pytest.importorskip("rerun")
    file = tmp_path / "a.rrd"
    recordings.write(recording, file)
    tool("verify", str(file))
    shown = tool("print", "-v", str(file))
    for name in ("marker", "waist", "shoulder"):
        assert [line for line in shown.splitlines() if f"/{name} " in line and "with 6 rows" in line], shown


def test_each_segment_is_a_path_of_its_own(recording: Recording) -> None:
    assert [len(run) for run in runs(recording)] == [3, 2, 1]


def test_without_the_extra_the_error_names_it_and_leaves_no_file(tmp_path, recording, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(RecordingError, match=r"bodyschema\[rerun\]"):
        recordings.write(recording, tmp_path / "a.rrd")
    assert list(tmp_path.iterdir()) == []
