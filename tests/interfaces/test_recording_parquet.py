from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from bodyschema.interfaces.errors import RecordingError
from bodyschema.recordings.recording import Recording

JOINTS = ("waist", "shoulder")
GOOD = {"waist": [0.1, 0.3], "shoulder": [0.2, 0.4], "x": [1.0, 4.0], "y": [2.0, 5.0], "z": [3.0, 6.0]}


def parquet(file: Path, columns: dict[str, list]) -> Path:
    arrow = pytest.importorskip("pyarrow")
    pytest.importorskip("pyarrow.parquet").write_table(arrow.table(columns), file)
    return file


def fault(file: Path) -> RecordingError:
    with pytest.raises(RecordingError) as caught:
        Recording.read(file, JOINTS)
    assert str(file) in str(caught.value)
    return caught.value


def test_parquet_of_another_tool_is_read(tmp_path: Path) -> None:
    np = pytest.importorskip("numpy")
    columns = GOOD | {"segment": [1, 1], "x": np.array([1, 4], dtype=np.float32)}
    recording = Recording.read(parquet(tmp_path / "a.parquet", columns), JOINTS)
    assert recording.x.tolist() == [[1, 2, 3], [4, 5, 6]]


@pytest.mark.parametrize(
    ("change", "column", "says"),
    [
        ({"x": [1.0, None]}, "x", "row 2: the value is missing"),
        ({"x": [1.0, float("nan")]}, "x", "row 2: nan is not a finite number"),
        ({"y": ["one", "two"]}, "y", "not numbers"),
        ({"unheard_of": [1.0, 2.0]}, "unheard_of", "unknown column"),
        ({"t": [2.0, 1.0]}, "t", "row 2: the time"),
    ],
)
def test_parquet_error_states_row_and_column(tmp_path: Path, change, column, says) -> None:
    error = fault(parquet(tmp_path / "a.parquet", GOOD | change))
    assert says in str(error)
    assert error.column == column


def test_a_parquet_without_rows_is_refused(tmp_path: Path) -> None:
    empty = {name: np.zeros(0) for name in GOOD}
    assert "no rows" in fault(parquet(tmp_path / "a.parquet", empty)).what


def test_a_torn_parquet_is_refused(tmp_path: Path) -> None:
    file = parquet(tmp_path / "a.parquet", GOOD)
    file.write_bytes(file.read_bytes()[:-20])
    assert "not a whole Parquet file" in fault(file).what


def test_without_the_extra_the_remedy_names_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    recording = Recording(JOINTS, np.zeros((1, 2)), np.zeros((1, 3)))
    file = tmp_path / "a.parquet"
    with pytest.raises(RecordingError, match=r"bodyschema\[export\]"):
        recording.write_parquet(file)
    assert not file.exists()
