from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bodyschema.interfaces.errors import RecordingError
from bodyschema.recordings.recording import Recording

JOINTS = ("waist", "shoulder")
numbers = st.floats(allow_nan=False, allow_infinity=False, width=64)


def column(rows: int, values: st.SearchStrategy[float] = numbers) -> st.SearchStrategy[list[float]]:
    return st.lists(values, min_size=rows, max_size=rows)


@st.composite
def recordings(draw: st.DrawFn) -> Recording:
    n = draw(st.integers(1, 6))
    optional = draw(st.sets(st.sampled_from(["t", "segment", "cov", "centres_px", "orientation", "extra"])))
    fields: dict[str, object] = {}
    if "t" in optional:
        fields["t"] = sorted(draw(st.sets(st.floats(-1e9, 1e9), min_size=n, max_size=n)))
    if "segment" in optional:
        fields["segment"] = draw(st.lists(st.integers(-(2**53), 2**53), min_size=n, max_size=n))
    if "cov" in optional:
        roots = np.array(draw(column(9 * n, st.floats(-1, 1)))).reshape(n, 3, 3)
        scale = draw(st.floats(1e-12, 1e3))
        cov = (roots @ roots.swapaxes(1, 2) + np.eye(3)) * scale
        fields["cov"] = (cov + cov.swapaxes(1, 2)) / 2
    if "centres_px" in optional:
        fields["centres_px"] = np.array(draw(column(4 * n))).reshape(n, 4)
    if "orientation" in optional:
        angles = np.array(draw(column(n, st.floats(-7, 7))))
        zero = np.zeros(n)
        fields["orientation"] = np.column_stack([zero, np.sin(angles), zero, np.cos(angles)])
    if "extra" in optional:
        fields["extra"] = {
            "current_shoulder": np.array(draw(column(n))),
            "temperature_waist": np.array(draw(column(n))),
        }
    q = np.array(draw(column(2 * n))).reshape(n, 2)
    x = np.array(draw(column(3 * n, st.floats(-1e9, 1e9)))).reshape(n, 3)
    return Recording(JOINTS, q, x, **fields)  # pyright: ignore[reportArgumentType]


def assert_same(one: Recording, other: Recording) -> None:
    assert one.joints == other.joints
    for name in ("q", "x", "t", "cov", "segment", "centres_px", "orientation"):
        a, b = getattr(one, name), getattr(other, name)
        assert (a is None) == (b is None)
        if a is not None:
            assert a.tobytes() == b.tobytes(), name
    assert {name: values.tobytes() for name, values in one.extra.items()} == {
        name: values.tobytes() for name, values in other.extra.items()
    }


def attempt(file: Path) -> tuple[Recording | None, str]:
    try:
        return Recording.read(file, JOINTS), ""
    except RecordingError as error:
        return None, str(error)


@given(recordings(), st.sampled_from([".csv", ".parquet"]))
def test_every_bit_survives_a_round_trip(recording: Recording, ending: str) -> None:
    if ending == ".parquet":
        pytest.importorskip("pyarrow")
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / f"recording{ending}"
        (recording.write_csv if ending == ".csv" else recording.write_parquet)(file)
        assert_same(recording, Recording.read(file, JOINTS))


@given(recordings(), st.data())
def test_mutated_csv_is_rejected_or_still_valid(recording: Recording, data: st.DataObject) -> None:
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "recording.csv"
        recording.write_csv(file)
        content = bytearray(file.read_bytes())
        for _ in range(data.draw(st.integers(1, 4))):
            place = data.draw(st.integers(0, len(content)))
            removed = data.draw(st.integers(0, 8))
            content[place : place + removed] = data.draw(st.binary(max_size=3) | st.sampled_from(MUTATIONS))
        file.write_bytes(content)
        read, refusal = attempt(file)
        if read is None:
            assert str(file) in refusal
        else:
            assert len(read) == content.count(b"\n") - 1
            assert np.isfinite(read.q).all()


@given(recordings(), st.data())
def test_mutated_parquet_is_rejected_or_still_valid(recording: Recording, data: st.DataObject) -> None:
    pytest.importorskip("pyarrow")
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "recording.parquet"
        recording.write_parquet(file)
        content = bytearray(file.read_bytes())
        place = data.draw(st.integers(0, len(content) - 1))
        content[place : place + data.draw(st.integers(0, 20))] = data.draw(st.binary(max_size=8))
        file.write_bytes(content)
        read, refusal = attempt(file)
        assert str(file) in refusal if read is None else np.isfinite(read.q).all()


MUTATIONS = [
    b"\n",
    b",",
    b"nan",
    b"inf",
    b"1e999",
    b"-",
    b"\r",
    b"\x00",
    b"\xff",
    b'"',
    b" ",
    b"_",
    b"\n\n",
    b"t",
    b"0x1p3",
]
